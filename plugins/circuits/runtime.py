"""Circuits on IBM's devices, through Qiskit Runtime: jobs in a batch or a session, and its error mitigation.

A fake device is a snapshot of a real one. Runtime simulates it here, through the same calls, its mitigation included.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.errors import OptionError
from qrlsuite.plugins.circuits.options import NOISE_FACTORS, QiskitOptions


class Runtime:
    """A circuit on one device.

    Parameters
    ----------
    device:
        Qiskit's backend.
    circuit:
        A `QuantumCircuit` with R parameters.
    observables:
        `SparsePauliOp`s on its qubits.
    """

    def __init__(self, options: QiskitOptions, device: Any, circuit: Any, observables: Sequence[Any]) -> None:
        from qiskit import transpile

        self.options, self.device = options, device
        if device.num_qubits < circuit.num_qubits:
            raise OptionError(
                f"device = '{options.device}' has {device.num_qubits} qubits, the circuit {circuit.num_qubits}"
            )
        if (status := self._status()) is not None and not status.operational:
            raise OptionError(f"device = '{options.device}' is out of service: {status.status_msg}")
        try:
            self._circuit = transpile(circuit, device, seed_transpiler=0, optimization_level=1)
        except Exception as error:
            raise OptionError(
                f"device = '{options.device}' cannot run this circuit: {_line(error)}"
            ) from error
        self._observables = [each.apply_layout(self._circuit.layout) for each in observables]
        self._opened: Any = None

    def __call__(self, rotations: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
        """Return expectation values (lanes, observables) of angles (lanes, R) from one job.

        Parameters
        ----------
        seed:
            Of the samples of a fake device.
        """
        from qiskit_ibm_runtime.executor_estimator import Estimator

        estimator = Estimator(mode=self._mode())
        chosen = estimator.options
        chosen.resilience_level = 0
        chosen.default_shots = self.options.shots
        chosen.resilience.measure_mitigation = self.options.mitigation != "none"
        chosen.resilience.zne_mitigation = self.options.mitigation == "zero-noise"
        if self.options.mitigation == "zero-noise":
            chosen.resilience.zne.noise_factors = NOISE_FACTORS
        if fake_device(self.options.device or ""):
            chosen.simulator.seed_simulator = seed % 2**31
        angles = [rotations] if rotations.shape[1] else []
        (result,) = estimator.run([(self._circuit, [[each] for each in self._observables], *angles)]).result()
        means = np.asarray(result.data.evs, np.float64).reshape(len(self._observables), -1).T
        return np.broadcast_to(means, (len(rotations), len(self._observables)))

    def terms(self, circuits: int) -> str:
        """Say how many jobs wait, and how long the device takes for a number of circuits."""
        delay = getattr(self.device, "default_rep_delay", None) or 0.0
        try:
            duration = self._circuit.estimate_duration(self.device.target)
        except Exception:  # of a device that does not say how long its gates take
            duration = 0.0
        longer = NOISE_FACTORS if self.options.mitigation == "zero-noise" else (1,)
        seconds = circuits * (self.options.shots or 0) * (delay + duration * np.mean(longer))
        status = self._status()
        waiting = "" if status is None else f"{status.pending_jobs} jobs wait at {self.options.device}; "
        charged = (
            "and it charges for an open session"
            if self.options.runtime == "session"
            else "which it charges for"
        )
        return f"{waiting}about {seconds:,.0f} s of the time of IBM's device, {charged}"

    def _status(self) -> Any:
        asked = getattr(self.device, "status", None)
        try:
            return None if asked is None else asked()
        except Exception as error:
            raise OptionError(f"device = '{self.options.device}' does not answer: {_line(error)}") from error

    def _mode(self) -> Any:
        """Return the batch or session, opened with the first job and closed with this object."""
        from qiskit_ibm_runtime import Batch, Session

        if self.options.runtime == "job":
            return self.device
        if self._opened is None:
            self._opened = (Batch if self.options.runtime == "batch" else Session)(backend=self.device)
            weakref.finalize(self, self._opened.close)
        return self._opened


def fake_device(name: str) -> bool:
    """Return whether this is the name of a snapshot of a device."""
    return name.startswith(("Fake", "Generic"))


def open_device(name: str) -> Any:
    """Return one of IBM's devices by its name, from the account that is saved on this machine."""
    from qiskit_ibm_runtime import QiskitRuntimeService
    from qiskit_ibm_runtime.accounts import AccountNotFoundError

    try:
        return QiskitRuntimeService().backend(name)
    except AccountNotFoundError as error:
        raise OptionError(
            f"device = '{name}': no account of IBM Quantum is saved here; in Python, once: "
            "qiskit_ibm_runtime.QiskitRuntimeService.save_account(token=...). To try it without one, take a fake "
            "device, such as FakeManilaV2"
        ) from error
    except Exception as error:
        raise OptionError(f"device = '{name}' cannot be opened: {_line(error)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
