"""Diagnostics of a circuit over its size, and of trained agents beside themselves before training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from qrlsuite.leaderboard.pictures import style
from qrlsuite.training.diagnosis import MEASURES, PARAMETERS, Diagnosis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINES = {"trained": "-", "initial": "--"}
LEVELS = (25, 50, 75)


def draw_circuit(found: Any) -> Figure:
    """Draw a `qrlsuite.api.diagnosis.CircuitDiagnosis`: four pictures over the circuit's size."""
    figure = Figure(figsize=(9.6, 6.6), layout="constrained")
    (gradients, eigenvalues), (spectrum, states) = figure.subplots(2, 2)
    laws: dict[int, list[Any]] = {}
    grows = found.depth.endswith("n")
    for each in found.sizes:
        laws.setdefault(0 if grows else each.layers, []).append(each)
    for number, (layers, sizes) in enumerate(laws.items()):
        look = style.style(number)
        depth = f"{found.depth if grows else layers} layers"
        for readout, line in (("local", "-"), ("global", "--")):
            rows = [(e.qubits, *e.variances[readout]) for e in sizes if readout in e.variances]
            rows = [row for row in rows if row[1] > 0]
            if not rows:
                continue
            n, value, low, high = zip(*rows)
            gradients.plot(
                n, value, line, marker=look.marker, ms=4, color=look.color, label=f"{readout}, {depth}"
            )
            gradients.fill_between(n, low, high, color=look.color, alpha=0.2, lw=0)
        for attribute, line in (("expressibility", "-"), ("entanglement", "--")):
            rows = [(e.qubits, getattr(e, attribute)) for e in sizes if getattr(e, attribute) is not None]
            if rows:
                label = f"{attribute}, {depth}"
                states.plot(*zip(*rows), line, marker=look.marker, ms=4, color=look.color, label=label)
    known = [e for e in found.sizes if e.information is not None]
    for number, each in enumerate(known[:: max(1, -(-len(known) // 5))]):
        look = style.style(number)
        label = f"{each.qubits} qubits, {each.layers} layers"
        values = np.mean([i.eigenvalues for i in each.information], axis=0)
        eigenvalues.plot(np.arange(1, len(values) + 1), _positive(values), color=look.color, label=label)
        if each.power is not None:
            spectrum.plot(
                each.frequencies[1:], _positive(each.power[1:]), color=look.color, lw=1, label=label
            )
    gradients.set(yscale="log", xlabel="qubits", title="variance of the gradient")
    eigenvalues.set(yscale="log", xlabel="direction", title="eigenvalues of the Fisher information")
    spectrum.set(
        yscale="log", xlabel="frequency (waves in a turn of an input)", title="power along the inputs"
    )
    states.set(xlabel="qubits", title="states: divergence from Haar, and Meyer-Wallach", ylim=(0, None))
    for axes in (gradients, states):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _finish(gradients, eigenvalues, spectrum, states)
    figure.suptitle(style.plain(found.name))
    style.footnotes(
        figure,
        f"{found.draws} random draws; bands: 5% to 95%",
        "local: Z of qubit 0; global: product of all Z",
    )
    return figure


def draw_agents(measured: Sequence[Diagnosis], title: str = "") -> Figure:
    """Draw Fisher information, spectra and entanglement; initial parameters are dashed.

    Parameters
    ----------
    measured:
        One or more entries, each in a color of its own.
    """
    figure = Figure(figsize=(9.6, 6.6), layout="constrained")
    (eigenvalues, spectrum), below = figure.subplots(2, 2)
    for number, each in enumerate(measured):
        color = style.style(number).color
        for which in PARAMETERS:
            line = {"color": color, "ls": LINES[which], "label": style.plain(f"{each.name}, {which}")}
            if each.information:
                values = np.mean([i.eigenvalues for i in each.information[which]], axis=0)
                eigenvalues.plot(np.arange(1, len(values) + 1), _positive(values), lw=1.5, **line)
                power = each.powers[which].mean(axis=0)
                spectrum.plot(np.arange(1, len(power) + 1), _positive(power), lw=1.5, **line)
            for axes, measure in zip(below, MEASURES):
                if not each.entanglement:
                    continue
                values = each.entanglement[which][measure].reshape(-1, len(each.steps))
                shown = ~np.isnan(values).all(axis=0)
                low, middle, high = np.nanpercentile(values[:, shown], LEVELS, axis=0)
                axes.plot(each.steps[shown], middle, lw=1.5, **line)
                axes.fill_between(each.steps[shown], low, high, color=color, alpha=0.15, lw=0)
    eigenvalues.set(yscale="log", xlabel="direction", title="eigenvalues of the Fisher information")
    spectrum.set(yscale="log", xlabel="waves in the visited range of an input", title="power of the outputs")
    for axes, measure in zip(below, MEASURES):
        axes.set(
            xlabel="step of the episode", title=measure, ylim=(0, 1.02 if measure == MEASURES[0] else None)
        )
    _finish(eigenvalues, spectrum, *below)
    if title:
        figure.suptitle(style.plain(title))
    style.footnotes(
        figure,
        "above: means over agents",
        "below: median and middle half over agents and episodes, entropy in bits",
    )
    return figure


def _positive(values: Any) -> Any:
    """Return values for an axis of logarithms, without values that are 0 or rounding errors."""
    return np.where(values > 1e-12 * np.nanmax(values, initial=0.0), values, np.nan)


def _finish(*panels: Axes) -> None:
    for axes in panels:
        style.tidy(axes)
        if axes.lines:
            axes.legend(fontsize=7, frameon=False, handlelength=3)
        else:
            axes.text(0.5, 0.5, "not computed", ha="center", transform=axes.transAxes)
