"""Counts executions of circuits."""

from __future__ import annotations


class ExecutionCounter:
    """Circuit executions of each agent; the agents of a population do the same number.

    Deep copies of a model (target networks) share their original's counter.

    Attributes
    ----------
    shots:
        Repetitions of each circuit; None where expectation values are exact.
    forward:
        Circuits executed in forward passes: one per input and measurement basis.
    gradient:
        Circuits executed for gradients, where shots or noise are simulated. Exact simulators differentiate otherwise;
        so that entries can be compared, theirs are the circuits that the parameter-shift rule would need for the
        gradients taken, as on hardware: per input two for every variable angle of an uncontrolled rotation, four for
        one of a controlled rotation.
    per_gradient:
        The number of circuits for the gradient at one input.
    mean_field:
        Whether the model is a mean-field approximation, which is no circuit and executes none.
    bases:
        Circuits per input: measurement bases, each as often as it is repeated to mitigate errors.
    """

    def __init__(
        self, shots: int | None, per_gradient: int, mean_field: bool = False, bases: int = 1
    ) -> None:
        self.mean_field = mean_field
        self.bases = bases
        self.shots = shots
        self.per_gradient = per_gradient
        self.forward = 0
        self.gradient = 0

    def as_dict(self) -> dict[str, int]:
        """Return the counts: `forward`, `parameter_shift`, and with finite shots the `shots` of both together.

        A mean-field approximation has none.
        """
        if self.mean_field:
            return {}
        counts = {"forward": self.forward, "parameter_shift": self.gradient}
        if self.shots is not None:
            counts["shots"] = self.shots * (self.forward + self.gradient)
        return counts

    def count_forward(self, inputs: int) -> None:
        """Count a forward pass at a number of inputs."""
        self.forward += inputs * self.bases

    def count_backward(self, inputs: int) -> None:
        """Count a backward pass at a number of inputs."""
        self.gradient += inputs * self.per_gradient
