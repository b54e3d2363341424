"""The native simulator against the released numbers, PennyLane, plain linear algebra, and itself in other company."""

from __future__ import annotations

import copy
import math
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from qrlsuite.circuit import Circuit, ansatz, expectations
from qrlsuite.circuit.description import GATES
from qrlsuite.errors import OptionError
from qrlsuite.plugins.circuits.native import NativeBackend, dense
from qrlsuite.plugins.circuits.native.program import HADAMARD, JOINED, PERMUTE, ROTATE, SIGN, compile_circuit
from qrlsuite.testing.dense import expectation_values
from tests.conftest import HANGS, golden

GOLDEN = golden("vqc")
PATHS = ["kernels", "torch", *(["cuda"] if torch.cuda.is_available() else [])]


def run(backend: NativeBackend, path: str, inputs: Tensor, parameters: dict[str, Tensor]) -> Tensor:
    """Run the compiled kernels, or the torch path that serves other devices: on the CPU, and where there is a GPU."""
    if path == "kernels":
        return backend(inputs, parameters)
    if path == "cuda":
        return backend(inputs.cuda(), {name: value.cuda() for name, value in parameters.items()}).cpu()
    flat = torch.cat([parameters[name].reshape(len(inputs), -1) for name in backend.shapes], dim=1)
    return dense.expectations(backend.program, inputs, flat)


def named(case: dict[str, object]) -> str:
    return f"{case['structure']}-{case['gate']}-{case['qubits']}"


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("case", GOLDEN, ids=named)
def test_the_released_codes_numbers(case: dict[str, object], dtype: torch.dtype, path: str) -> None:
    circuit = ansatz(case["structure"], qubits=case["qubits"], layers=case["layers"], gate=case["gate"])
    x = torch.tensor(case["inputs"], dtype=dtype)[None].requires_grad_()
    parameters = {
        n: torch.tensor(case[n], dtype=dtype)[None].requires_grad_() for n in ("scaling", "weights")
    }
    values = run(NativeBackend(circuit), path, x, parameters)
    values.backward(torch.tensor(case["cotangent"], dtype=dtype)[None])
    exact = dtype == torch.float64
    np.testing.assert_allclose(values.detach()[0], case["expval_z"], rtol=0, atol=1e-10 if exact else 1e-5)
    for name, got in (("inputs", x), *parameters.items()):
        atol = 1e-10 if exact else 1e-4
        np.testing.assert_allclose(got.grad[0], case[f"grad_{name}"], rtol=0, atol=atol, err_msg=name)


@st.composite
def circuits(draw: st.DrawFn) -> Circuit:
    """Any circuit: every gate, controls, shared parameters and inputs, constants, chosen observables."""
    n = draw(st.integers(1, 5))
    circuit = Circuit(n, inputs=draw(st.integers(1, 3)))
    a, b = circuit.parameter("a", (2, 2)), circuit.parameter("b", (3,))
    for _ in range(draw(st.integers(1, 20))):
        gate = draw(st.sampled_from([g for g, s in GATES.items() if s.wires <= n]))
        signature = GATES[gate]
        wires = draw(st.permutations(range(n)))[: signature.wires + 1]
        control = None
        if signature.controllable and n > signature.wires and draw(st.booleans()):
            control = wires[-1]
        angles = []
        for _ in range(signature.angles):
            x = circuit.input(draw(st.integers(0, circuit.inputs - 1)))
            kinds = [0.7, x, a[1, 0], a[0, draw(st.integers(0, 1))] * x, b[2] * x + a[1, 1], x + b[0] + 0.3]
            angles.append(draw(st.sampled_from(kinds)))
        circuit.append(gate, wires[: signature.wires], *angles, control=control)
    if draw(st.booleans()):
        circuit.measure(draw(st.permutations(range(n)))[: draw(st.integers(1, n))])
    return circuit


def random_values(
    circuit: Circuit, seeds: int, batch: int, dtype: torch.dtype
) -> tuple[Tensor, dict[str, Tensor]]:
    source = torch.Generator().manual_seed(7)
    x = 4 * torch.rand(seeds, batch, circuit.inputs, generator=source, dtype=dtype) - 2
    parameters = {
        name: 6.3 * torch.rand(seeds, *p.shape, generator=source, dtype=dtype)
        for name, p in circuit.parameters.items()
    }
    return x, parameters


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(circuits())
def test_any_circuit_equals_linear_algebra(circuit: Circuit) -> None:
    x, parameters = random_values(circuit, 1, 2, torch.float64)
    values = {name: p[0].numpy() for name, p in parameters.items()}
    expected = [expectation_values(circuit, sample, values) for sample in x[0].numpy()]
    for path in PATHS:
        got = run(NativeBackend(circuit), path, x, parameters)[0]
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12, err_msg=path)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(circuits())
def test_any_circuits_gradients_equal_pennylanes(circuit: Circuit) -> None:
    x, parameters = random_values(circuit, 1, 3, torch.float64)
    results = []
    for backend in ("pennylane", "native", "torch"):
        leaf = x[0].clone().requires_grad_()
        state = {name: p[0].clone().requires_grad_() for name, p in parameters.items()}
        if backend == "torch":
            given = {name: value[None] for name, value in state.items()}
            values = run(NativeBackend(circuit), "torch", leaf[None], given)[0]
        else:
            values = expectations(circuit, leaf, state, backend=backend)
        weights = torch.linspace(-1, 1, values.numel(), dtype=torch.float64).view_as(values)
        if values.requires_grad:  # not where no angle depends on anything
            (values * weights).sum().backward()
        zeros = [torch.zeros_like(t) if t.grad is None else t.grad for t in (leaf, *state.values())]
        results.append([values.detach(), *zeros])
    for other in results[1:]:
        for mine, theirs in zip(other, results[0]):
            torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("batch", [1, 10, 64, 100])
def test_a_seed_does_not_depend_on_its_company(batch: int, dtype: torch.dtype) -> None:
    circuit = ansatz("cz", qubits=4, layers=2)
    backend = NativeBackend(circuit)
    x, parameters = random_values(circuit, 17, batch, dtype)
    cotangent = torch.rand(17, batch, 4, dtype=dtype, generator=torch.Generator().manual_seed(1))

    def slice_of(first: int, last: int) -> list[Tensor]:
        leaves = [t[first:last].clone().requires_grad_() for t in (x, *parameters.values())]
        values = backend(leaves[0], dict(zip(parameters, leaves[1:])))
        values.backward(cotangent[first:last])
        return [values.detach(), *(leaf.grad for leaf in leaves)]

    whole = slice_of(0, 17)
    for first, last in ((0, 1), (16, 17), (3, 5), (5, 16)):
        for part, all_ in zip(slice_of(first, last), whole):
            assert torch.equal(part, all_[first:last])


def test_a_forward_pass_alone_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    circuit = ansatz("iqp", qubits=5, layers=3)
    x, parameters = random_values(circuit, 2, 20, torch.float32)
    backend = NativeBackend(circuit)
    with torch.no_grad():
        alone = backend(x, parameters)
    leaves = {name: p.clone().requires_grad_() for name, p in parameters.items()}
    together = backend(x, leaves)
    together.sum().backward()
    assert torch.equal(alone, together)
    monkeypatch.setattr("qrlsuite.plugins.circuits.native.cpu.KEEP_BYTES", 0)
    again = {name: p.clone().requires_grad_() for name, p in parameters.items()}
    backend(x, again).sum().backward()
    for name in leaves:
        assert torch.equal(leaves[name].grad, again[name].grad), "recomputed states differ from kept ones"


@pytest.mark.parametrize(
    ("dtype", "size", "message"),
    [
        (torch.float32, 3e4, r"float32 holds angles up to about 1e7, .* input is 3e\+04, .* 3e\+04: .* in float64$"),
        (torch.float64, 1e9, r"float64 holds angles up to about 1e15, .* initial parameters smaller$"),
    ],
)  # fmt: skip
def test_angles_that_the_precision_cannot_hold_are_not_called_infinite(
    dtype: torch.dtype, size: float, message: str
) -> None:
    """Each angle is a product of input and scaling: the square of `size`, up to which each of them is finite."""
    circuit = ansatz("cx", qubits=4, layers=4)
    backend = NativeBackend(circuit)
    x, parameters = random_values(circuit, 1, 1, dtype)
    large = {name: torch.full_like(p, size) for name, p in parameters.items()}
    assert bool(torch.isfinite(backend(torch.full_like(x, size), parameters)).all())
    with pytest.raises(OptionError, match=message):
        backend(torch.full_like(x, size), large)


def test_a_second_backward_pass_gives_the_same() -> None:
    circuit = ansatz("cx", qubits=3, layers=2)
    x, parameters = random_values(circuit, 1, 4, torch.float64)
    weights = parameters["weights"].requires_grad_()
    loss = NativeBackend(circuit)(x, parameters).sum()
    (first,) = torch.autograd.grad(loss, [weights], retain_graph=True)
    (second,) = torch.autograd.grad(loss, [weights])
    assert torch.equal(first, second)


@pytest.mark.parametrize("name", ["iqp", "cx", "cz"])
def test_programs_are_as_short_as_they_should_be(name: str) -> None:
    """10 qubits, 4 layers: opening Hadamards are free, others join blocks, rings of fixed gates are one sweep."""
    kinds = compile_circuit(ansatz(name, qubits=10, layers=4)).steps[:, 0].tolist()
    assert kinds.count(ROTATE) == 40
    expected = {"iqp": [0, 0, 0], "cx": [0, 3, 0], "cz": [0, 0, 3]}
    assert [kinds.count(k) for k in (HADAMARD, PERMUTE, SIGN)] == expected[name]
    xyz = compile_circuit(ansatz(name, qubits=10, layers=4, gate="xyz")).steps[:, 0].tolist()
    assert xyz.count(ROTATE) == 40, "three rotations of one target under one control are one block"


def test_hadamards_without_factor_stay_within_the_range_of_float32() -> None:
    """198 Hadamards behind blocks: were all done without their factor, overlaps would grow by 2^198."""
    circuit = ansatz("iqp", qubits=2, layers=100)
    assert compile_circuit(circuit).components[0, 6] == JOINED
    x, parameters = random_values(circuit, 1, 2, torch.float32)
    results = []
    for path in ("kernels", "torch"):
        leaves = {name: p.clone().requires_grad_() for name, p in parameters.items()}
        values = run(NativeBackend(circuit), path, x, leaves)
        values.sum().backward()
        results.append([values.detach(), *(leaf.grad for leaf in leaves.values())])
    for compiled, plain in zip(*results):
        torch.testing.assert_close(compiled, plain, rtol=0, atol=1e-4)


def test_state_memory_at_14_qubits() -> None:
    backend = NativeBackend(ansatz("iqp", qubits=14, layers=4))
    work = backend.simulator().workspace(torch.float32)
    kept = 4 * work.record.nbytes  # 64 samples are 4 chunks of 16 lanes
    buffers = [*work.scratch, work.pair, work.overlap, work.sums, work.slopes, work.record]
    assert kept + sum(b.nbytes for b in buffers) < 64 << 20


def test_one_and_twenty_qubits() -> None:
    one = Circuit(1)
    one.append("RY", 0, one.input(0))
    value = expectations(one, [[0.3]], {}, backend="native")
    assert float(value) == pytest.approx(math.cos(0.3), abs=1e-12)
    twenty = Circuit(20, inputs=1)
    twenty.append("RX", 19, twenty.input(0))
    twenty.append("CNOT", (19, 0))
    values = expectations(twenty, [[0.3]], {}, backend="native", dtype="float32")[0]
    expected = [math.cos(0.3), *[1.0] * 18, math.cos(0.3)]
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("path", PATHS)
def test_qubits_that_no_gate_connects_have_states_of_their_own(path: str) -> None:
    """64 qubits as easily as 6: RX(a) and RY(b) on |0> give cos a cos b on every qubit."""
    circuit = Circuit(64)
    weights = circuit.parameter("weights", (64,))
    for q in range(64):
        circuit.append("RX", q, circuit.input(q))
        circuit.append("RY", q, weights[q])
    assert compile_circuit(circuit).amplitudes == 128
    x, parameters = random_values(circuit, 2, 20, torch.float64)
    w = parameters["weights"].requires_grad_()
    values = run(NativeBackend(circuit), path, x, {"weights": w})
    torch.testing.assert_close(values.detach(), x.cos() * w.detach().cos()[:, None], rtol=0, atol=1e-12)
    values.sum().backward()
    expected = -x.cos().sum(1) * w.detach().sin()
    torch.testing.assert_close(w.grad, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": torch.zeros(2, 3)}, r"inputs have shape \(2, 3\): this circuit needs \(seeds, batch, 3\)"),
        ({"inputs": torch.zeros(2, 4, 5)}, "needs"),
        ({"inputs": torch.zeros(2, 4, 3, dtype=torch.int64)}, "dtype torch.int64"),
        ({"weights": None}, r"parameter 'weights' of shape \(2, 2, 3, 3\) is missing"),
        ({"weights": torch.zeros(1, 2, 3, 3)}, r"has shape \(1, 2, 3, 3\), expected is \(2, 2, 3, 3\)"),
        ({"weights": torch.zeros(2, 2, 3, 3, dtype=torch.float64)}, "has dtype torch.float64"),
        ({"inputs": torch.full((2, 4, 3), math.nan)}, "not finite"),
    ],
)  # fmt: skip
def test_wrong_arguments(change: dict[str, Tensor | None], message: str) -> None:
    backend = NativeBackend(ansatz("cz", qubits=3, layers=2))
    given = {
        "inputs": torch.zeros(2, 4, 3),
        "scaling": torch.zeros(2, 2, 3, 3),
        "weights": torch.zeros(2, 2, 3, 3),
    }
    given |= {k: v for k, v in change.items() if v is not None}
    for name in [k for k, v in change.items() if v is None]:
        del given[name]
    with pytest.raises(OptionError, match=message):
        backend(given.pop("inputs"), given)


def test_copies_share_the_compiled_program() -> None:
    backend = NativeBackend(ansatz("cz", qubits=2, layers=1))
    assert copy.deepcopy(backend) is backend


@pytest.mark.skipif(platform.machine() != "x86_64", reason="names processors of this architecture")
def test_vectors_fill_the_registers_of_the_processor_that_numba_compiles_for() -> None:
    program = "from qrlsuite.compiled.vectors import FUSED, lanes; print(4 * lanes('float32'), FUSED)"
    for processor, found in (("x86-64", "16 False"), ("haswell", "32 True"), ("skylake-avx512", "64 True")):
        env = {**os.environ, "NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""}
        words = [sys.executable, "-c", program]
        assert (
            subprocess.run(words, env=env, capture_output=True, text=True, check=True).stdout.strip() == found
        )


def test_code_for_arm_has_vectors_and_fused_multiplications() -> None:
    """Not run here, but compiled: a block's sweep, with this machine's lanes, for an ARM processor."""
    import llvmlite.binding as llvm
    import numba

    from qrlsuite.plugins.circuits.native.sweeps import rotate

    def sweep(state: object, gates: object) -> None:
        rotate(state, 3, 0, 1, gates, 0, 0, 0, 0)

    signature = (numba.types.Array(numba.float32, 2, "C"),) * 2
    options = {"fastmath": {"contract"}, "error_model": "numpy", "_nrt": False, "no_cpython_wrapper": True}
    compiled = numba.njit(**options)(sweep)  # alone: numba's own code around it is for this machine
    compiled.compile(signature)
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple("aarch64-unknown-linux-gnu").create_target_machine(opt=3)
    code = re.sub(r'target (triple|datalayout) = ".*"\n', "", compiled.inspect_llvm(signature))
    module = llvm.parse_assembly(code)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    assembly = machine.emit_assembly(module)
    assert re.search(r"fmla\s+v\d+\.4s", assembly)


def test_the_compile_cache_depends_on_every_source_file_and_the_processor(tmp_path: Path) -> None:
    """A changed source is never served from a stale cache, and two processes may fill it at once."""
    from qrlsuite.compiled import cache

    for name in ("compiled", "native"):
        (tmp_path / name).mkdir()
    for path in Path(cache.__file__).parent.glob("*.py"):
        (tmp_path / "compiled" / path.name).write_bytes(path.read_bytes())
    (tmp_path / "native/kernels.py").touch()
    program = (
        "import importlib.util, pathlib, sys; s = importlib.util.spec_from_file_location('c', sys.argv[1]); "
        "m = importlib.util.module_from_spec(s); s.loader.exec_module(m); print(m.folder(pathlib.Path(sys.argv[2])))"
    )

    def folder(**variables: str) -> str:
        command = [
            sys.executable,
            "-c",
            program,
            str(tmp_path / "compiled/cache.py"),
            str(tmp_path / "native"),
        ]
        env = {"QRLSUITE_CACHE": str(tmp_path), **variables}
        return subprocess.run(command, capture_output=True, text=True, check=True, env=env).stdout

    first = folder()
    assert folder() == first
    assert first.startswith(str(tmp_path))
    generic = folder(NUMBA_CPU_NAME="generic")
    assert len({first, generic, folder(NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="+neon")}) == 3
    for changed in ("compiled/vectors.py", "native/kernels.py"):
        (tmp_path / changed).write_text((tmp_path / changed).read_text() + "\n")
        before, first = first, folder()
        assert before != first


CALL = """
import sys, torch
from qrlsuite.circuit import ansatz, expectations
c = ansatz("cz", qubits=2, layers=1)
p = {n: torch.ones(q.shape, dtype=torch.float64, requires_grad=True) for n, q in c.parameters.items()}
v = expectations(c, torch.ones(3, 2, dtype=torch.float64), p, backend="native")
v.sum().backward()
print(v.tolist())
"""


def test_a_later_process_starts_from_the_cache() -> None:
    circuit = ansatz("cz", qubits=2, layers=1)
    parameters = {
        name: torch.ones(p.shape, dtype=torch.float64, requires_grad=True)
        for name, p in circuit.parameters.items()
    }
    values = expectations(circuit, torch.ones(3, 2, dtype=torch.float64), parameters, backend="native")
    values.sum().backward()  # compiled now, if not before
    later = subprocess.run([sys.executable, "-c", CALL], capture_output=True, text=True, check=True)
    assert (later.stdout, later.stderr) == (f"{values.tolist()}\n", "")


@pytest.mark.long
def test_two_processes_may_compile_at_once_and_later_ones_start_from_the_cache(tmp_path: Path) -> None:
    env = {**os.environ, "QRLSUITE_CACHE": str(tmp_path)}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", CALL], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env
        )
        for _ in range(2)
    ]
    printed = [process.communicate(timeout=HANGS) for process in both]
    assert [process.returncode for process in both] == [0, 0], printed
    assert printed[0][0] == printed[1][0]
    assert "compiling the circuit simulator" in printed[0][1] + printed[1][1]
    third = subprocess.run([sys.executable, "-c", CALL], capture_output=True, text=True, check=True, env=env)
    assert third.stdout == printed[0][0]
    assert third.stderr == ""
