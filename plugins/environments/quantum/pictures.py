"""Pictures of the quantum tasks: Bloch spheres with fields, growing circuits, and counts of measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
INK, PALE = "#202428", "#c8ccd0"


def figure(width: float, height: float) -> Figure:
    """Return an empty figure of `width` x `height` inches, 100 pixels each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), dpi=100, facecolor="white", layout="constrained")
    made.get_layout_engine().set(w_pad=0.12, h_pad=0.08)  # type: ignore[union-attr, call-arg]
    FigureCanvasAgg(made)
    return made


def pixels(drawn: Figure) -> NDArray[np.uint8]:
    """Return a figure as an image (height, width, 3)."""
    canvas: Any = drawn.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def pulse(
    vectors: NDArray[np.float64],
    paths: NDArray[np.float64],
    fidelity: NDArray[np.float64],
    fields: Sequence[NDArray[np.float64]],
    options: Any,
) -> Figure:
    """Draw the qubits' paths in their Bloch spheres, and below them the fields and the fidelity.

    Parameters
    ----------
    vectors, paths:
        Bloch vectors after each step (K + 1, qubits, 3), and as many more as make a path smooth.
    fidelity, fields:
        After each step, (K + 1,), and in each, K of (qubits,).
    """
    qubits, steps = options.qubits, options.steps
    drawn = figure(3.6 * qubits, 5.4)
    grid = drawn.add_gridspec(2, qubits, height_ratios=(3.6, 1.8))
    for q in range(qubits):
        axes: Any = drawn.add_subplot(grid[0, q], projection="3d")
        _sphere(axes)
        axes.plot(*paths[:, q].T, color=COLORS[q], lw=1.4)
        axes.scatter(*vectors[:, q].T, color=COLORS[q], s=9, depthshade=False)
        axes.scatter(*vectors[-1:, q].T, color=INK, s=34, depthshade=False)
        if qubits == 1:
            axes.scatter([0], [0], [-1], marker="*", color=COLORS[2], s=120, depthshade=False)
        else:
            axes.set_title(f"qubit {q}", fontsize=9, color=INK)
    below = drawn.add_subplot(grid[1, :])
    times = np.arange(steps + 1) * (options.duration / steps)
    for q in range(qubits):
        values = [each[q] for each in fields]
        name = f"field {q} / strength" if qubits > 1 else "field / strength"
        below.stairs(values, times[: len(values) + 1], color=COLORS[q], lw=1.4, label=name)
    below.plot(times[: len(fidelity)], fidelity, ".-", color=COLORS[2], lw=1, label="fidelity")
    below.set(xlim=(0, times[-1]), ylim=(-0.05, 1.05))
    below.set_xlabel("time, hbar / h", fontsize=8)
    below.legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, 1.22), ncols=3)
    _plain(below)
    below.set_title(f"F = {fidelity[-1]:.3f}", fontsize=9, color=INK, loc="right")
    return drawn


def _sphere(axes: Any) -> None:
    angle = np.linspace(0, 2 * np.pi, 73)
    zero, cos, sin = np.zeros_like(angle), np.cos(angle), np.sin(angle)
    for circle in ((cos, sin, zero), (cos, zero, sin), (zero, cos, sin)):
        axes.plot(*circle, color=PALE, lw=0.8)
    for axis, name in ((0, "x"), (1, "y")):
        ends = np.zeros((2, 3))
        ends[:, axis] = -1, 1
        axes.plot(*ends.T, color=PALE, lw=0.8)
        axes.text(*(1.15 * ends[1]), name, fontsize=8, color=INK, ha="center")
    axes.plot([0, 0], [0, 0], [-1, 1], color=PALE, lw=0.8)
    axes.text(0, 0, 1.12, "|0>", fontsize=8, color=INK, ha="center")
    axes.text(0, 0, -1.28, "|1>", fontsize=8, color=INK, ha="center")
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
    axes.view_init(elev=18, azim=35)
    axes.set_axis_off()


def _plain(axes: Axes) -> None:
    axes.tick_params(length=2, labelsize=7, colors="#606468")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_edgecolor("#a0a4a8")


def circuit(axes: Axes, gates: Sequence[tuple[str, tuple[int, ...]]], qubits: int, columns: int) -> None:
    """Draw gates, the first at the left; `columns` is how many there is room for."""
    for q in range(qubits):
        axes.plot([-0.7, columns - 0.3], [-q, -q], color=PALE, lw=1, zorder=0)
        axes.text(-0.9, -q, str(q), fontsize=8, color=INK, ha="right", va="center")
    for column, (name, at) in enumerate(gates):
        if len(at) == 2:
            axes.plot([column, column], [-at[0], -at[1]], color=COLORS[1], lw=1.4, zorder=1)
            axes.plot(column, -at[0], "o", color=COLORS[1], ms=5)
            axes.plot(column, -at[1], "o", color="white", mec=COLORS[1], ms=10)
            axes.plot(column, -at[1], "+", color=COLORS[1], ms=10)
        else:
            box = {"boxstyle": "square,pad=0.3", "facecolor": COLORS[0], "edgecolor": "white"}
            axes.text(column, -at[0], name, fontsize=8, color="white", ha="center", va="center", bbox=box)
    axes.set(xlim=(-1.3, columns - 0.3), ylim=(-qubits + 0.4, 0.6))
    axes.set_axis_off()


def clifford(
    gates: Sequence[tuple[str, tuple[int, ...]]], left: NDArray[np.int64], qubits: int, steps: int
) -> Figure:
    """Draw a circuit, and beside it the remaining matrix, which should become the identity."""
    drawn = figure(2.2 + 0.3 * steps, 0.9 + 0.45 * qubits)
    wide, narrow = drawn.subplots(1, 2, width_ratios=(0.3 * steps, 1.8))
    circuit(wide, gates, qubits, steps)
    wide.set_title(f"{len(gates)} of {steps} gates", fontsize=9, color=INK, loc="left")
    rgb = np.full((*left.shape, 3), 255, np.uint8)
    rgb[left == 1] = (0, 114, 178)
    rgb[(left == 1) & (np.eye(len(left)) == 0)] = (213, 94, 0)
    narrow.imshow(rgb)
    names = [f"{letter}{q}" for letter in "XZ" for q in range(qubits)]
    narrow.set_xticks(range(len(left)), [name.lower() for name in names], fontsize=6)
    narrow.set_yticks(range(len(left)), names, fontsize=6)
    narrow.tick_params(length=0)
    done = (left == np.eye(len(left))).all()
    narrow.set_title("done" if done else "remains", fontsize=9, color=INK)
    return drawn


def vqe(
    gates: Sequence[tuple[str, tuple[int, ...]]],
    angles: Sequence[float],
    above: Sequence[float],
    options: Any,
    title: str,
    gap: float,
) -> Figure:
    """Draw a circuit with its angles, and below it the energy above the ground state's after each gate."""
    drawn = figure(1.6 + 0.62 * options.steps, 2.6 + 0.5 * options.qubits)
    top, below = drawn.subplots(2, 1, height_ratios=(0.5 * options.qubits, 1.8))
    shown = [
        (name if len(at) == 2 else f"RY\n{angle / np.pi:+.2f}$\\pi$", at)
        for (name, at), angle in zip(gates, angles)
    ]
    circuit(top, shown, options.qubits, options.steps)
    top.set_title(f"{options.model}, {title}", fontsize=9, color=INK, loc="left")
    steps = np.arange(len(above))
    shown_above = np.maximum(above, 1e-8)  # zero but for rounding
    below.semilogy(steps, shown_above, "o-", color=COLORS[2], lw=1.2, ms=4)
    below.axhline(gap, color=COLORS[1], lw=1, ls="--")
    below.text(options.steps, gap, "without CX ", fontsize=7, color=COLORS[1], ha="right", va="bottom")
    below.set(xlim=(-0.3, options.steps + 0.1), ylim=(min(shown_above.min(), gap) / 3, None))
    unit = "Hartree" if options.model == "h2" else "coupling"
    below.set_ylabel(f"energy error, {unit}", fontsize=8)
    below.set_xlabel("gates", fontsize=8)
    _plain(below)
    return drawn


def channel(
    counts: NDArray[np.int64],
    believed: NDArray[np.float64],
    inputs: Sequence[str],
    channels: Sequence[str],
    kind: int,
    named: int,
) -> Figure:
    """Draw how often +1 and -1 were measured, and how probable each channel is; the true one is bold."""
    drawn = figure(7.2, 3.0)
    left, right = drawn.subplots(1, 2, width_ratios=(3, 4))
    tried = counts.sum(1).reshape(len(inputs), 3)
    left.imshow(tried, cmap="Blues", vmin=0, vmax=max(6, int(tried.max()) * 1.5))
    for k, (minus, plus) in enumerate(counts.tolist()):
        if minus + plus:
            left.text(k % 3, k // 3, f"+{plus} -{minus}", ha="center", va="center", fontsize=8, color=INK)
    left.set_xticks(range(3), ["X", "Y", "Z"])
    left.set_yticks(range(len(inputs)), [f"|{state}>" for state in inputs])
    left.tick_params(length=0, labelsize=8)
    left.set_title(f"{int(counts.sum())} experiments", fontsize=9, color=INK, loc="left")
    right.barh(
        range(len(channels)), believed, color=[COLORS[2] if k == kind else PALE for k in range(len(channels))]
    )
    right.set_yticks(range(len(channels)), channels)
    right.get_yticklabels()[kind].set_fontweight("bold")
    right.invert_yaxis()
    right.set(xlim=(0, 1))
    _plain(right)
    said = f"named: {channels[named]}" if named >= 0 else "probability"
    right.set_title(said, fontsize=9, color=INK, loc="left")
    return drawn
