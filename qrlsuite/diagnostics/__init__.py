"""Diagnostics of a circuit or a network before and after training: arrays in, arrays out.

- `gradients`: how gradients shrink with the number of qubits;
- `fisher`: the Fisher information, directions without effect, and the effective dimension;
- `fourier`: the frequencies of a function along its inputs;
- `states`: expressibility and entanglement of states;
- `algebra`: the dimension of the Lie algebra that a circuit's generators make.

`circuits` applies them to a `Circuit`, `qrlsuite.training.diagnosis` to trained agents; `qrlsuite.api.diagnose` and
`qrlsuite diagnose` show both.
"""
