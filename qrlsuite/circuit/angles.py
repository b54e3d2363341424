"""All angles of a circuit at once, in torch: `constant + scale * input + weight` for S seeds and B inputs.

Backends that hand angles to somebody else's simulator compute them here, so that gradients of inputs, scales
and weights follow from the gradients of angles by autograd.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from qrlsuite.circuit.description import Circuit, Encoding
from qrlsuite.errors import CircuitError


class AngleTable:
    """The variable angles of a circuit, in order of application.

    Attributes
    ----------
    count:
        Number A of angles that depend on an input or a parameter. Constant ones are not among them.
    rows:
        For every operation, for each of its angles: its row 0..A-1, or its constant (a float).
    controlled:
        For every row, whether its gate has an extra control (then its generator has three eigenvalues).
    """

    def __init__(self, circuit: Circuit) -> None:
        self.names = list(circuit.parameters)
        offsets, total = {}, 0
        for name, parameter in circuit.parameters.items():
            offsets[name] = total
            total += parameter.size
        if not circuit.measures_z:
            raise CircuitError("observables of other Paulis are measured as Pauli Z by `create_backend`")
        self.rows: list[tuple[int | float, ...]] = []
        self.controlled: list[bool] = []
        feature: list[int] = []
        scale: list[int] = []
        weight: list[int] = []
        constant: list[float] = []
        for operation in circuit:
            rows: list[int | float] = []
            for angle in operation.angles:
                if not angle.varies:
                    rows.append(angle.constant)
                    continue
                if angle.product is not None or isinstance(angle.input, Encoding):
                    raise CircuitError("functions of inputs are written as inputs by `create_backend`")
                rows.append(len(constant))
                constant.append(angle.constant)
                self.controlled.append(operation.control is not None)
                # Two values behind the parameters, 0 and 1, stand for absent scales and weights.
                feature.append(angle.input or 0)
                if angle.input is None:
                    scale.append(total)
                elif angle.scale is None:
                    scale.append(total + 1)
                else:
                    scale.append(offsets[angle.scale.parameter] + angle.scale.index)
                weight.append(
                    total if angle.weight is None else offsets[angle.weight.parameter] + angle.weight.index
                )
            self.rows.append(tuple(rows))
        self.count = len(constant)
        self._feature = torch.tensor(feature, dtype=torch.int64)
        self._scale = torch.tensor(scale, dtype=torch.int64)
        self._weight = torch.tensor(weight, dtype=torch.int64)
        self._constant = torch.tensor(constant, dtype=torch.float64)
        self._has_constant = any(constant)

    def __call__(self, inputs: Tensor, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the angles in radians, (A, S, B), from inputs (S, B, in) and parameters (S, *shape).

        Every agent's values and gradients are the same bits at every place in the stack: sums over the batch run
        along the last axis.
        """
        S = inputs.shape[0]
        fillers = inputs.new_tensor([0.0, 1.0]).expand(S, 2)
        flat = torch.cat([*(parameters[name].reshape(S, -1) for name in self.names), fillers], dim=1).t()
        device = inputs.device
        features = inputs.permute(2, 0, 1).index_select(0, self._feature.to(device))
        scale = flat.index_select(0, self._scale.to(device))[..., None]
        weight = flat.index_select(0, self._weight.to(device))[..., None]
        angles = scale * features + weight
        if self._has_constant:
            angles = angles + self._constant.to(inputs)[:, None, None]
        return angles
