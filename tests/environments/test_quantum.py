"""The quantum tasks: their physics by hand or by exhaustion, their reference policies, and both forms of each."""

from __future__ import annotations

import warnings
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from qrlsuite.actions import draw
from qrlsuite.environment import EpisodeLanes
from qrlsuite.errors import OptionError, StoreError
from qrlsuite.plugins.environments.quantum import channel, clifford, episode, pulse, vqe
from qrlsuite.plugins.environments.quantum.channel import (
    Channel,
    ChannelLanes,
    ChannelOptions,
    Informative,
    InTurn,
)
from qrlsuite.plugins.environments.quantum.clifford import (
    Clifford,
    CliffordLanes,
    CliffordOptions,
    GreedyCircuit,
    ShortestCircuit,
)
from qrlsuite.plugins.environments.quantum.lanes import Drawn, pauli
from qrlsuite.plugins.environments.quantum.pulse import (
    BestPulse,
    GreedyPulse,
    Pulse,
    PulseLanes,
    PulseOptions,
)
from qrlsuite.plugins.environments.quantum.vqe import VQE, BestCircuit, GreedyGate, VQELanes, VQEOptions

SINGLE: list[Drawn] = [
    Pulse(steps=9, render_mode="rgb_array"),
    Pulse(
        qubits=2, control="continuous", steps=9, dephasing=0.1, miscalibration=0.1, render_mode="rgb_array"
    ),
    Clifford(qubits=3, steps=9, render_mode="rgb_array"),
    VQE(model="ising", qubits=3, steps=7, render_mode="rgb_array"),
    Channel(render_mode="rgb_array"),
]
each = pytest.mark.parametrize(
    "env", SINGLE, ids=lambda env: f"{env.lanes.name}-{env.lanes.single_action_space}"
)


def scores(lanes: EpisodeLanes, policy: Any = None, seed: int = 0) -> NDArray[np.float64]:
    """Return the scores of one episode in every lane; without a policy, of random actions."""
    lanes.autoreset = False
    seen, _ = lanes.reset(seed=seed)
    act, generator = policy(lanes) if policy else None, np.random.default_rng(seed)
    result = np.full(lanes.num_envs, np.nan)
    while np.isnan(result).any():
        actions = act(seen) if act else draw(lanes.single_action_space, generator, lanes.num_envs)
        seen, _, terminated, truncated, infos = lanes.step(actions)
        done = terminated | truncated
        result[done] = infos["final_info"]["score"][done] if done.any() else 0
    return result


@each
def test_alone_and_in_lanes_the_same_bits_and_a_picture(env: Drawn) -> None:
    """Stable-Baselines3's checker is content; a lane plays what the single form plays, wherever it is."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)
    options, seeds = env.lanes.options, [5, 6, 7]  # type: ignore[attr-defined]
    lanes = type(env.lanes)(options, 3)  # type: ignore[call-arg, arg-type]
    lanes.seed_lanes([gymnasium.utils.seeding.np_random(seed)[0] for seed in seeds])
    seen, _ = lanes.reset()
    rows = draw(lanes.single_action_space, np.random.default_rng(0), options.steps, 3)
    alone, _ = env.reset(seed=6)
    np.testing.assert_array_equal(alone, seen[1])
    for row in rows:
        seen, rewards, terminated, truncated, infos = lanes.step(row)
        alone, reward, ended, cut, info = env.step(row[1])
        assert (reward, ended, cut) == (rewards[1], terminated[1], truncated[1])
        if ended or cut:
            assert info["score"] == infos["final_info"]["score"][1]
            break
        np.testing.assert_array_equal(alone, seen[1])
    image: Any = env.render()
    assert image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10


@pytest.mark.parametrize("qubits", [1, 2])
def test_a_pulse_solves_the_lindblad_equation(qubits: int) -> None:
    """Many short steps against the exponential of the superoperator; no step changes the trace."""
    options = PulseOptions(
        qubits=qubits, control="continuous", steps=400, duration=2.0, dephasing=0.3, miscalibration=0.2
    )
    lanes = PulseLanes(options, 1)
    lanes.autoreset = False
    lanes.reset(seed=1)
    rho, e, fields = lanes.rho[0].copy(), lanes.error[0], [0.25, 0.75][:qubits]
    if qubits == 1:
        h = (4 * (1 + e) * fields[0] * pauli("Z") + pauli("X")) / 2
    else:
        z = 4 * (1 + e) * (fields[0] * pauli("ZI") + fields[1] * pauli("IZ"))
        h = (z + pauli("XI") + pauli("IX") + pauli("ZZ")) / 2
    one = np.eye(2**qubits)
    generator = -1j * (np.kron(h, one) - np.kron(one, h.T))
    for word in ["Z"] if qubits == 1 else ["ZI", "IZ"]:
        generator += 0.3 / 2 * (np.kron(pauli(word), pauli(word)) - np.eye(4**qubits))
    exact = (expm(2.0 * generator) @ rho.reshape(-1)).reshape(rho.shape)
    total = 0.0
    for _ in range(400):
        _, (reward,), _, _, infos = lanes.step(np.array([[2 * u - 1 for u in fields]], np.float32))
        total += reward
    np.testing.assert_allclose(lanes.rho[0], exact, atol=1e-5)
    start = (lanes.target.conj() @ rho @ lanes.target).real
    assert infos["final_info"]["score"][0] == pytest.approx(start + total)


def test_best_pulses_are_the_best_and_beat_greedy_ones() -> None:
    """Switched fields with noise: no pulse of 7 steps is better. Continuous fields: the bound is reached."""
    lanes = PulseLanes(PulseOptions(steps=7, dephasing=0.1, miscalibration=0.2), 8)
    found, best = scores(lanes, BestPulse), np.zeros(8)
    for actions in product(range(2), repeat=7):
        lanes.reset(seed=0)
        for action in actions:
            _, _, _, _, infos = lanes.step(np.full(8, action))
        best = np.maximum(best, infos["final_info"]["score"])
    np.testing.assert_allclose(found, best, atol=1e-12)
    assert (scores(PulseLanes(lanes.options, 8), GreedyPulse) <= found + 1e-12).all()
    noisy = PulseLanes(PulseOptions(qubits=2, steps=3, dephasing=0.1, miscalibration=0.2), 1)
    noisy.reset(seed=0)
    fields = np.array([[0.2, 0.7], [0.5, 0.5], [1.0, 0.0]])  # with energies that are equal
    slopes = pulse._infidelity(noisy, 0, fields)[1]
    for k, step in enumerate(1e-6 * np.eye(6).reshape(6, 3, 2)):
        above, below = (pulse._infidelity(noisy, 0, fields + sign * step)[0] for sign in (1, -1))
        assert slopes[k] == pytest.approx((above - below) / 2e-6, abs=1e-8)
    free = PulseLanes(PulseOptions(qubits=2, control="continuous", start="zero", steps=10), 1)
    assert scores(free, BestPulse)[0] > 0.999
    with pytest.raises(OptionError, match=r"2\^50 pulses are too many"):
        BestPulse(PulseLanes(PulseOptions(qubits=2, steps=25), 1))


def test_gates_are_what_their_matrices_say() -> None:
    """Every gate against U P U^dagger, whose word it must be but for its sign."""
    h, s, cx = (pauli("X") + pauli("Z")) / np.sqrt(2), np.diag([1, 1j]), np.eye(4)[[0, 1, 3, 2]]
    options = CliffordOptions(qubits=2)
    swap = np.eye(4)[[0, 2, 1, 3]]
    for (name, at), matrix in zip(clifford.gates(options), clifford.matrices(options)):
        if name == "CX":
            unitary = cx if at == (0, 1) else swap @ cx @ swap
        else:
            one = h if name == "H" else s
            unitary = np.kron(one, np.eye(2)) if at == (0,) else np.kron(np.eye(2), one)
        for bits in product((0, 1), repeat=4):
            before, after = (
                pauli("".join("IZXY"[2 * v[q] + v[2 + q]] for q in range(2)))
                for v in (bits, bits @ matrix % 2)
            )
            overlap = np.trace(unitary @ before @ unitary.conj().T @ after) / 4
            assert abs(overlap) == pytest.approx(1), (name, at, bits)


def test_operations_are_written_and_by_no_circuit_that_is_shorter() -> None:
    """All 720 operations of two qubits are found; the policy takes as many gates as it says, where greedy ones fail."""
    lanes = CliffordLanes(CliffordOptions(), 64)
    policy = ShortestCircuit(lanes)
    lanes.reset(seed=0)
    lengths = policy.lengths(lanes.left)
    assert (len(policy._known), policy._far.max(), lengths.min() > 0) == (720, 8, True)
    assert scores(lanes, ShortestCircuit).tolist() == [1.0] * 64
    assert lanes.step_count.tolist() == lengths.tolist()
    assert 0.1 < scores(lanes, GreedyCircuit).mean() < 0.9
    target = Clifford(qubits=3, coupling="ring", scramble=5)
    target.reset(seed=2)
    circuit, left = [], target.lanes.left[0]
    for action in np.random.default_rng(0).integers(len(target.lanes.gates), size=7):
        target.step(action)
        circuit.append(target.lanes.matrices[action])
    for matrix in reversed(circuit):
        target.lanes.left[0] = matrix @ target.lanes.left[0] % 2
    np.testing.assert_array_equal(target.lanes.left[0], left)
    with pytest.raises(OptionError, match="four qubits are not known"):
        ShortestCircuit(CliffordLanes(CliffordOptions(qubits=4), 1))


@pytest.mark.parametrize(
    ("options", "at", "known"),
    [
        (
            VQEOptions(),
            3,
            0.2252 - 0.5716 - np.hypot(0.3435 + 0.4347, 2 * 0.0910),
        ),  # 0.75 Angstrom: |01> and |10>
        (VQEOptions(model="ising", steps=3), 5, -np.hypot(1, 2)),  # g = 1: the two states that are symmetric
    ],
)
def test_energies_are_those_of_dense_matrices(options: VQEOptions, at: int, known: float) -> None:
    """Exact ones by hand, in the block of two states that matters; those of a circuit by matrices; angles are best."""
    lanes = VQELanes(options, 1)
    _, exact = vqe.energies(options)
    assert exact[at] == pytest.approx(known, abs=1e-12)
    lanes.reset(seed=0)
    for action in (0, 2, 1):
        lanes.autoreset = False
        lanes.step(np.array([action]))
    h, y, cx = lanes.matrices[lanes.which[0]], pauli("Y"), np.eye(4)[[0, 1, 3, 2]]

    def energy(first: float, second: float) -> float:
        state = np.eye(4)[0]
        for gate in (
            np.kron(expm(-0.5j * first * y), np.eye(2)),
            cx,
            np.kron(np.eye(2), expm(-0.5j * second * y)),
        ):
            state = gate @ state
        return float((state.conj() @ h @ state).real)

    first, _, second = lanes.angles[0, :3]
    assert energy(first, second) == pytest.approx(lanes.energy[0], abs=1e-12)
    assert all(energy(first, second + turn) >= lanes.energy[0] - 1e-12 for turn in np.linspace(0, 6, 30))


def test_circuits_of_six_gates_reach_the_ground_states_of_hydrogen() -> None:
    lanes = VQELanes(VQEOptions(), 64)
    np.testing.assert_allclose(scores(lanes, BestCircuit), 1, atol=1e-6)
    assert np.abs(lanes.above()).max() < 1e-8
    assert scores(lanes, GreedyGate).max() < 1e-6, "greedy circuits never entangle here"
    with pytest.raises(OptionError, match='the model "h2" has 2'):
        VQE(qubits=3)


def test_circuits_of_eight_gates_reach_the_ground_states_of_three_spins() -> None:
    lanes = VQELanes(VQEOptions(model="ising", qubits=3, steps=8), 64)
    np.testing.assert_allclose(scores(lanes, BestCircuit), 1, atol=1e-6)
    assert 0.5 < scores(lanes, GreedyGate).mean() < 0.9


def test_outcomes_are_those_of_kraus_operators() -> None:
    """Every channel and experiment; and who asks what is informative is right more often."""
    p, paulis = 0.3, [pauli(letter) for letter in "XYZ"]
    flips = [[np.sqrt(1 - p) * np.eye(2), np.sqrt(p) * one] for one in (paulis[0], paulis[1], paulis[2])]
    mixed = [np.sqrt(1 - 3 * p / 4) * np.eye(2), *(np.sqrt(p / 4) * one for one in paulis)]
    damped = [np.diag([1, np.sqrt(1 - p)]), np.array([[0, np.sqrt(p)], [0, 0]])]
    states = np.array([[1, 0], [0, 1], [1 / np.sqrt(2), 1 / np.sqrt(2)], [1 / np.sqrt(2), 1j / np.sqrt(2)]])
    for row, kraus in zip(channel.probabilities(p), [*flips, mixed, damped], strict=True):
        for k, (state, basis) in enumerate(product(states, paulis)):
            rho = sum(each @ np.outer(state, state.conj()) @ each.conj().T for each in kraus)
            assert row[k] == pytest.approx((1 + np.trace(rho @ basis).real) / 2)
    lanes = ChannelLanes(ChannelOptions(steps=3), 500)
    lanes.autoreset = False
    lanes.reset(seed=0)
    returns = lanes.step(np.full(500, 2))[1] + lanes.step(np.full(500, 6))[1]
    likelihood = np.prod(np.stack([1 - lanes.plus, lanes.plus], -1) ** lanes.counts[:, None], (2, 3))
    np.testing.assert_allclose(lanes.believed, likelihood / likelihood.sum(1, keepdims=True))
    names = np.arange(500) % 5
    _, rewards, _, _, infos = lanes.step(12 + names)
    believed = lanes.believed[np.arange(500), names]
    np.testing.assert_allclose(returns + rewards, believed - 0.2, atol=1e-12)
    assert infos["final_info"]["score"].mean() == pytest.approx(believed.mean(), abs=0.1), "5 standard errors"
    informed, in_turn = (
        scores(ChannelLanes(ChannelOptions(), 400), policy) for policy in (Informative, InTurn)
    )
    assert informed.mean() > 0.9 > in_turn.mean() > 0.4


def test_a_picture_of_an_episode_of_every_task() -> None:
    worlds = [make(steps=4) for make in (PulseOptions, CliffordOptions, VQEOptions, ChannelOptions)]
    drawn = episode.episode(dict(zip("abcd", worlds)), episode.EpisodeOptions())
    assert [len(axes.images) for axes in drawn.axes] == [1] * 4
    alone = episode.episode({"a": worlds[0]}, episode.EpisodeOptions(policy="greedy"))
    assert len(alone.axes[-1].lines[-1].get_xdata()) == 5, "the fidelity, at the start and after each step"


@each
def test_states_that_cannot_be(env: Drawn) -> None:
    lanes: Any = env.lanes
    lanes.reset(seed=0)
    state = lanes.state_dict()
    for name in ("step", *lanes._arrays()):
        wrong = np.full_like(state[name], np.nan if state[name].dtype.kind == "f" else 100)
        with pytest.raises(StoreError, match="the state is none of"):
            lanes.load_state_dict({**state, name: wrong})
    with pytest.raises(OptionError, match="takes no option"):
        lanes.reset(options={"low": 0})


def test_registered_by_import() -> None:
    assert {f"qrlsuite/{name}-v1" for name in ("Channel", "Clifford", "Pulse", "VQE")} <= set(
        gymnasium.registry
    )
