"""Training and validating a group of seeds in memory: no files, no claims, no trackers.

A group is one population, trained in one process on one thread. Everything that the rest of its training depends on
is in `Trainer.capture()` or keyed by the epoch, so that a group captured after any epoch and restored elsewhere ends
with the same curves and parameters, byte for byte, as one never stopped.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

import qrlsuite
from qrlsuite import actions as action_spaces
from qrlsuite import own, population, registry, specs
from qrlsuite.circuit import CircuitModel
from qrlsuite.device import Ahead, Captured, DeviceLanes, LateChecks
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import EnvironmentFailure, OptionError, PluginError, QrlSuiteError, StoreError
from qrlsuite.experiment.entry import Entry
from qrlsuite.gymlanes import GymLanes
from qrlsuite.results.checkpoint import Arrays
from qrlsuite.results.progress import Progress
from qrlsuite.seeding import Streams, pack, stream_key, unpack
from qrlsuite.training import questions, unregistered
from qrlsuite.training.devices import find as find_device
from qrlsuite.training.fences import seeded
from qrlsuite.training.metering import MeteredEnv
from qrlsuite.training.standardization import PREFIX, RunningStatistics

MAX_EPISODE_STEPS = 100_000
"""An episode that has not ended after so many steps is an error, not an endless loop."""

Floats = NDArray[np.float64]
Policy = Callable[..., NDArray[Any]]
"""Maps observations (lanes, ...) to actions (lanes, ...), see `informed`."""
Infos = Mapping[str, Any]

Report = Callable[[Progress], None]


@contextlib.contextmanager
def _building(spec: specs.Spec) -> Iterator[None]:
    """Turn whatever a plugin raises while something of it is built into one message with the place in its code."""
    try:
        yield
    except OptionError as error:
        raise own.placed(error) from None
    except QrlSuiteError:
        raise
    except Exception as error:
        owner = registry.load().get(type(spec), spec.name).distribution
        raise PluginError(f"{spec.title} of {owner} cannot be built: {own.failure(error)}") from error


def build_envs(entry: Entry, lanes: int, tick: Callable[[], None]) -> MeteredEnv:
    """Build the task's environment with a number of lanes."""
    spec = entry.task.environment
    settings = entry.task.environment_options
    inner: LaneEnv
    with _building(spec):
        if spec.vector is not None:
            inner = specs.resolve(spec.vector)(settings, lanes)
        else:
            qrlsuite.register_environments()
            inner = GymLanes(spec.gymnasium_id, lanes, dataclasses.asdict(settings))
    return MeteredEnv(inner, spec.name, entry.task.file.score, tick)


def require_actions(entry: Entry, space: spaces.Space[Any]) -> None:
    """Refuse an algorithm that does not take the actions of the entry's environment."""
    try:
        kind = action_spaces.kind(space)
    except OptionError as error:
        raise OptionError(f"environment '{entry.task.environment.name}': {error}") from None
    if kind in entry.algorithm.actions:
        return
    registered = registry.load()
    others = [each for each in registered.names(specs.AlgorithmSpec)
              if kind in registry.get(specs.AlgorithmSpec, each).actions]  # fmt: skip
    advice = (
        f"take one of {', '.join(others)}: qrlsuite run '{others[0]} {entry.model.name}'"
        if others
        else "none does"
    )
    if registered.of(specs.AlgorithmSpec)[entry.algorithm.name].distribution != "qrlsuite":
        advice += (
            f"; if it does take them, write actions={(*entry.algorithm.actions, kind)} in its AlgorithmSpec"
        )
    raise OptionError(
        f"algorithm '{entry.algorithm.name}' takes {' and '.join(entry.algorithm.actions)} actions, and "
        f"task '{entry.task.name}' has {space}: {advice}"
    )


def require_trainable(entries: Sequence[Entry]) -> str:
    """Refuse an algorithm, a model and a task that do not fit; agents are built for it and not trained.

    A third party's model that hides state from torch is refused, too (`qrlsuite.training.unregistered`), and one whose
    seeds share their weights, or an environment whose seeds share their episodes (`qrlsuite.training.questions`).

    Parameters
    ----------
    entries:
        One or more that one population can train.

    Returns
    -------
    str
        Why the environment gave no answer; empty where it did.
    """
    entry = entries[0]
    if entry.model.name == specs.NO_MODEL:
        require_actions(entry, build_envs(entry, 1, lambda: None).single_action_space)
        return _require_own_episodes(entry)
    act = getattr(specs.resolve(entry.algorithm.factory), "act", len)
    if population.remembers(first_network(entry)) and not asks_for_more(act):
        raise _forgets(entry)
    if entry.third_party():
        Trainer(entries[:2], [0] * len(entries[:2]), checked=True)
    return _require_own_episodes(entry)


def _require_own_episodes(entry: Entry) -> str:
    """Refuse a third party's environment whose seeds share their episodes; return why it gave no answer."""
    spec = entry.task.environment
    if entry.registered()["environment"].distribution == "qrlsuite":
        return ""

    def make(seeds: Sequence[int]) -> LaneEnv:
        envs = build_envs(entry, 2 * len(seeds), lambda: None).inner
        streams = [Streams(entry.task.hash, seed) for seed in seeds]
        envs.seed_lanes([each.numpy("environment", lane) for each in streams for lane in range(2)])
        return envs

    unanswered = f"{spec.title} was not asked whether each seed meets its own episodes: "
    try:
        questions.require_reproducible(make, spec)
        if not spec.repeats and questions.drawn(make, spec) == "unknown":
            return f"{unanswered}that takes more than {questions.SECONDS:g} s of processor time"
    except PluginError:
        raise
    except Exception as error:  # which training may meet, too, and report
        return f"{unanswered}{own.failure(error)}"
    return ""


def _no_network(entry: Entry) -> OptionError:
    """Return the refusal of a model by an algorithm that builds no network when it is made."""
    name, model = entry.algorithm.name, entry.model.name
    return OptionError(
        f"algorithm '{name}' builds no network, so that model '{model}' would say nothing: write "
        f"'{name} {specs.NO_MODEL}'"
    )


def _forgets(entry: Entry) -> OptionError:
    """Return the refusal of a model that remembers by an algorithm that does not tell it where episodes begin."""
    model, known = entry.model.name, registry.load()
    found = [
        name
        for name in known.names(specs.AlgorithmSpec)
        if asks_for_more(getattr(specs.resolve(registry.get(specs.AlgorithmSpec, name).factory), "act", len))
    ]
    advice = (
        f"take one of {', '.join(found)}: qrlsuite run '{found[0]} {model}'"
        if found
        else "no algorithm here trains it"
    )
    return OptionError(
        f"model '{model}' remembers what it saw in an episode, and algorithm '{entry.algorithm.name}' would make it "
        f"forget: {advice}"
    )


class _FirstNetwork(Exception):
    """The sizes of the first network that an algorithm asks for."""


def first_network(entry: Entry) -> nn.Module:
    """Return one agent's freshly built first network; nothing is computed with it."""
    envs = build_envs(entry, 1, lambda: None)
    require_actions(entry, envs.single_action_space)
    size = int(np.prod(envs.single_observation_space.shape or (1,)))

    def ask(outputs: int, inputs: int | None = None, role: str = "network") -> nn.Module:
        raise _FirstNetwork(outputs, size if inputs is None else inputs, role)

    if isinstance(envs.single_action_space, spaces.Discrete):
        outputs, inputs, role = int(envs.single_action_space.n), size, "network"
    else:
        try:
            specs.resolve(entry.algorithm.factory)(
                envs, ask, entry.algorithm_options, [Streams(entry.task.hash, 0)], torch.device("cpu")
            )
        except _FirstNetwork as found:
            outputs, inputs, role = found.args
        else:
            raise _no_network(entry)
    with _building(entry.model), seeded(0):
        return build_agent(
            specs.resolve(entry.model.build),
            inputs,
            outputs,
            entry.model_options,
            torch.Generator(),
            observed_space(envs),
            role,
        )


def observed_space(envs: LaneEnv) -> spaces.Space[Any]:
    """Return the space of observations before they were flattened, as models that ask for it get it."""
    return envs.single_observation_space if envs.unflattened_space is None else envs.unflattened_space


def build_agent(
    build: Callable[..., nn.Module],
    inputs: int,
    outputs: int,
    options: Any,
    generator: torch.Generator,
    space: spaces.Space[Any],
    role: str = "network",
) -> nn.Module:
    """Build one agent's network by a model's `build`, which gets `space` and `role` if it has such parameters."""
    asked = inspect.signature(build).parameters
    more = {name: value for name, value in (("space", space), ("role", role)) if name in asked}
    return build(inputs, outputs, options, generator, **more)


def count_parameters(entry: Entry) -> tuple[int, int]:
    """Return the numbers of classical and quantum trainable scalars of an entry's first network."""
    return population.count_parameters(first_network(entry))


@dataclass(frozen=True)
class Episodes:
    """One complete episode of every lane.

    Attributes
    ----------
    returns, scores:
        Sums of rewards and scores (lanes,).
    lengths:
        Steps of each lane's episode (lanes,).
    rounds:
        Steps that every lane made: all lanes go on until the last episode has ended.
    metrics:
        Metrics of the environment by name, (lanes,); NaN where it measured none.
    """

    returns: Floats
    scores: Floats
    lengths: NDArray[np.int64]
    rounds: int
    metrics: dict[str, Floats]


def informed(policy: Policy) -> Callable[[NDArray[np.float32], NDArray[np.bool_], Infos], NDArray[Any]]:
    """Return a policy as a function of three arguments; a policy of one argument gets observations alone.

    `policy(observations, begins, infos)` also gets the lanes (lanes,) in which an episode begins with the observation,
    and the lanes' infos.
    """
    if asks_for_more(policy):
        return policy
    if asks_for_more(policy, "infos"):
        return lambda observations, begins, infos: policy(observations, infos=infos)
    return lambda observations, begins, infos: policy(observations)


def asks_for_more(function: Callable[..., Any], name: str = "begins") -> bool:
    """Tell whether a policy takes more than observations: `begins` and then `infos`, or `infos` alone."""
    try:
        given = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of another language
        return False
    return any(each.name == name or each.kind is inspect.Parameter.VAR_POSITIONAL for each in given)


def play_episodes(envs: MeteredEnv, begin: Callable[[], Policy], first: Any = None) -> Episodes:
    """Play one episode in every lane.

    Parameters
    ----------
    envs:
        Lanes whose streams are set, with `autoreset` off.
    begin:
        Called after the reset; returns the policy, which may ask for more than observations (`informed`).
    first:
        What the reset returned, if the lanes have been reset.
    """
    envs.take_finished()
    envs.take_metrics()
    metrics: dict[str, Floats] = {}
    observations, infos = envs.reset() if first is None else first
    policy = informed(begin())
    begins = np.ones(envs.num_envs, dtype=np.bool_)
    returns, scores = (np.full(envs.num_envs, np.nan) for _ in range(2))
    lengths = np.zeros(envs.num_envs, np.int64)
    unfinished = np.ones(envs.num_envs, dtype=np.bool_)
    for played in range(1, MAX_EPISODE_STEPS + 1):
        observations, _, terminated, truncated, infos = envs.step(policy(observations, begins, infos))
        begins = terminated | truncated
        if not begins.any():
            continue
        lanes, sums, final_scores = envs.take_finished()
        first = lanes[unfinished[lanes]]
        returns[first], scores[first] = sums[unfinished[lanes]], final_scores[unfinished[lanes]]
        lengths[first] = played
        for name, (where, values) in envs.take_metrics().items():
            row = metrics.setdefault(name, np.full(envs.num_envs, np.nan))
            new = unfinished[where]
            row[where[new]] = values[new]
        unfinished[lanes] = False
        if not unfinished.any():
            return Episodes(returns, scores, lengths, played, metrics)
    raise EnvironmentFailure(
        f"environment '{envs.environment_name}': an episode did not end within {MAX_EPISODE_STEPS} steps; "
        "give it a time limit"
    )


class DevicePlayer:
    """Plays the validation on a device, and then in the lanes themselves, which score it."""

    def __init__(self, envs: MeteredEnv, lanes: DeviceLanes, algorithm: Any, models: ModelBuilder) -> None:
        self.envs, self.lanes, self.algorithm, self.streams = envs, lanes, algorithm, models.streams
        self.steps: int = lanes.lanes.options.steps
        self.drawn = Ahead(self._draw)
        self._rounds = Captured(self._round, self._state, *models.built)

    def __call__(self, epoch: int) -> Episodes:
        """Play an epoch's validation."""
        first, drawn = self.drawn(epoch)
        self.lanes.begin(self.steps, drawn)
        self._rounds(self.steps)
        actions = iter(self.lanes.actions())
        episodes = play_episodes(self.envs, lambda: lambda observations: next(actions), first)
        return dataclasses.replace(episodes, rounds=self.steps)

    def _draw(self, epoch: int) -> tuple[Any, dict[str, Any]]:
        self.envs.seed_lanes([streams.numpy("validation", epoch) for streams in self.streams])
        return self.envs.reset(), self.lanes.draw(self.steps)

    def _state(self) -> dict[str, torch.Tensor]:
        return {**self.lanes.state, **self.algorithm.policy_state()}

    def _round(self) -> None:
        seen = self.lanes.state["observations"]
        self.lanes.step(self.algorithm.choose(seen.view(len(self.streams), -1, seen.shape[1])).view(-1))


class ModelBuilder:
    """Builds populations for an algorithm: every agent from its own seed's stream, every call from a new one.

    `entry` is the entry of all agents, or a list with one for each agent.

    With `statistics`, all of them standardize their observations by these. While an agent is built, the global
    generators have states of its own stream, so that layers of torch may be built as they are. With `checked`, a model
    that hides state from torch, or begins alike in all seeds, is refused (PluginError).
    """

    def __init__(
        self,
        entry: Entry | Sequence[Entry],
        envs: LaneEnv,
        streams: Sequence[Streams],
        statistics: RunningStatistics | None = None,
        initial: Mapping[int, Mapping[str, torch.Tensor]] | None = None,
        checked: bool = False,
    ) -> None:
        self.initial, self.checked = initial or {}, checked
        self.entries = [entry] * len(streams) if isinstance(entry, Entry) else list(entry)
        self.entry = self.entries[0]
        self.space = observed_space(envs)
        self.observation_size = int(np.prod(envs.single_observation_space.shape or (1,)))
        self.streams = streams
        self.statistics = statistics
        self.built: list[nn.Module] = []
        # classical, quantum and fixed numbers of each network built
        self.parameters: list[tuple[int, int, int]] = []

    def __call__(self, outputs: int, inputs: int | None = None, role: str = "network") -> nn.Module:
        """Return a population of freshly initialized agents, see `qrlsuite.algorithm.BuildModel`."""
        spec, options = self.entry.model, [entry.model_options for entry in self.entries]
        call = len(self.built)
        given = self.observation_size if inputs is None else inputs
        with _building(spec):
            build = specs.resolve(spec.build)

            def agent(streams: Streams, chosen: Any) -> nn.Module:
                with seeded(stream_key(streams.task_hash, streams.seed, "build", call)):
                    generator = streams.torch("init", call)
                    return build_agent(build, given, outputs, chosen, generator, self.space, role)

            if self.checked:
                seeds = [Streams(self.streams[0].task_hash, seed) for seed in range(questions.SEEDS)]
                stacked = spec.population is None  # a stack keeps one agent's plain attributes for all
                both = options[0], options[-1 if stacked else 0]
                unregistered.require_none(
                    lambda which: agent(seeds[which], both[which]), given, spec.name, stacked, outputs
                )
                questions.require_own_weights(lambda seed: agent(seeds[seed], options[0]), spec)
                questions.require_no_global_draw(agent(seeds[0], options[0]), torch.zeros(2, given), spec)
            agents = [agent(streams, chosen) for streams, chosen in zip(self.streams, options)]
            fixed = population.count_fixed(agents[0])
            self.parameters.append((*population.count_parameters(agents[0]), fixed))
            if spec.population is None:
                together = population.stack(agents)
            else:
                together = specs.resolve(spec.population)(agents, population.joined(options))
            with torch.no_grad():
                for name, value in self.initial.get(call, {}).items():
                    together.state_dict()[name].copy_(value)
        if hasattr(together, "executions") and not isinstance(together, CircuitModel):
            raise PluginError(
                f"model '{spec.name}' counts executions, but is no qrlsuite.circuit.CircuitModel: it lacks one of "
                "`description`, `simulator`, `compile_circuits` and `circuit_states`"
            )
        if self.statistics is not None:
            self.statistics.attach(together)
        self.built.append(together)
        return together

    def trained(self) -> dict[str, int]:
        """Return the trainable numbers of one agent, `classical` and `quantum`, summed over its trained `networks`.

        Numbers of these networks that stay as drawn are counted as `fixed`. A network that needs no gradients, such as
        a target network that was built here and frozen, does not count.
        """
        counted = [
            numbers
            for numbers, module in zip(self.parameters, self.built)
            if any(parameter.requires_grad for parameter in module.parameters())
        ]
        classical, quantum, fixed = (sum(numbers[kind] for numbers in counted) for kind in range(3))
        counts = {"classical": classical, "quantum": quantum, "networks": len(counted)}
        return {**counts, "fixed": fixed} if fixed else counts

    @property
    def circuits(self) -> list[CircuitModel]:
        """The networks with a circuit."""
        return [module for module in self.built if isinstance(module, CircuitModel)]

    def compile_circuits(self) -> None:
        """Let models of circuits compile before their first pass: no epoch's time and no estimate includes that."""
        for module in self.circuits:
            module.compile_circuits()

    def problems(self) -> list[str]:
        """Say why populations run slower than they might; each reason once."""
        problems = [getattr(module, "problem", None) for module in self.built]
        return list(dict.fromkeys(f"model '{self.entry.model.name}' {text}" for text in problems if text))

    def executions(self) -> dict[str, int]:
        """Return each agent's circuit executions so far, summed over its networks; empty without circuits."""
        total: dict[str, int] = {}
        for network in self.circuits:
            for name, count in network.executions.as_dict().items():
                total[name] = total.get(name, 0) + int(count)
        return total


@dataclass(frozen=True)
class Epoch:
    """One epoch of S seeds.

    Attributes
    ----------
    number:
        1 for the first.
    metrics:
        The algorithm's, and mean return and score of the training episodes that ended, (S,) each; NaN where there
        was none.
    scores:
        Validation scores (S, episodes).
    measured:
        Metrics of the environment by name (`info["metrics"]` at an episode's end), means over the validation's
        episodes, (S,) each; NaN where it measured none.
    executions:
        Circuit executions of each seed by name, validation included; empty without circuits.
    seconds:
        Wall time of training and validation, and on a processor its time, of the whole group.
    diverged:
        (S,): whether a number of the seed's policy is not finite after the epoch, or a metric of it is infinite.
    """

    number: int
    metrics: dict[str, Floats]
    scores: Floats
    measured: dict[str, Floats]
    executions: list[dict[str, int]]
    seconds: dict[str, float]
    diverged: NDArray[np.bool_]


class Trainer:
    """S agents, trained together and validated after every epoch: seeds of an entry, or of several.

    Begin with `start()` or `restore(...)`; then each `train_epoch()` adds one.

    Parameters
    ----------
    entry:
        The entry to train; or S entries, one for each seed, that differ in options per agent only: their
        `population_key` is equal.
    seeds:
        S seeds, all at the same epoch. Each stands once for every entry that it is of.
    device:
        Where the populations live: `cpu`, `cuda` or `cuda:1`.
    report:
        Called after every round with the group's progress.

    Attributes
    ----------
    epoch:
        Epochs finished.
    algorithm:
        The learning algorithm, see `qrlsuite.algorithm.Algorithm`.
    """

    def __init__(
        self,
        entry: Entry | Sequence[Entry],
        seeds: Sequence[int],
        device: str = "cpu",
        report: Report = lambda progress: None,
        checked: bool = False,
    ) -> None:
        torch.set_num_threads(1)
        self.seeds, self.report, self._checked = list(seeds), report, checked
        entries = [entry] * len(self.seeds) if isinstance(entry, Entry) else list(entry)
        distinct = {id(each): each for each in entries}.values()
        if len(entries) != len(self.seeds) or len({each.population_key for each in distinct}) > 1:
            raise ValueError(
                "agents of one population have one entry each, and these differ in options marked per_agent only"
            )
        self.entry = entry = entries[0]
        self.device = find_device(device)
        self.progress = Progress()
        self.epoch = 0
        self._warm, self._checks = False, LateChecks()
        protocol = entry.task.file.protocol
        self.S, self.E, self.V = len(self.seeds), protocol.environments, protocol.validation_episodes
        self.streams = [Streams(entry.task.hash, seed) for seed in self.seeds]
        self.envs = build_envs(entry, self.S * self.E, self._tick)
        require_actions(entry, self.envs.single_action_space)
        size = int(np.prod(self.envs.single_observation_space.shape or (1,)))
        self.statistics: RunningStatistics | None = None
        if self.envs.inner.running_statistics:
            self.statistics = RunningStatistics(self.S, self.E, size, self.device)
            self.envs.observe = self.statistics.observe
        self._entries = entries
        self._build({})
        self.envs.on_device = self._on_device(self.envs)

    def _build(self, initial: Mapping[int, Mapping[str, torch.Tensor]]) -> None:
        """Build networks and algorithm; `initial` has the networks' first parameters, by their number."""
        self.models = ModelBuilder(
            self._entries, self.envs, self.streams, self.statistics, initial, self._checked
        )
        with _building(self.entry.algorithm):
            factory = specs.resolve(self.entry.algorithm.factory)
            own_options = population.joined([each.algorithm_options for each in self._entries])
            self.algorithm = factory(self.envs, self.models, own_options, self.streams, self.device)
        if not self.models.built and self.entry.model.name != specs.NO_MODEL:
            raise _no_network(self.entry)
        if torch.get_default_dtype() is not torch.float32:
            raise PluginError(
                f"the code of {' or '.join(self.entry.third_party()) or 'a plugin'} has set torch's default dtype to "
                f"{torch.get_default_dtype()} for the whole process: give `dtype` to its own tensors instead"
            )
        self._informed = asks_for_more(self.algorithm.act)
        self._heeds = asks_for_more(self.algorithm.act, "infos")
        self._remembers = any(population.remembers(module) for module in self.models.built)
        if self._remembers and not self._informed:
            raise _forgets(self.entry)

    @functools.cached_property
    def validation(self) -> MeteredEnv:
        """The validation's lanes, built when first needed: trained agents are also played without them."""
        envs = build_envs(self.entry, self.S * self.V, self._tick)
        envs.inner.autoreset = False
        return envs

    @functools.cached_property
    def _player(self) -> DevicePlayer | None:
        """Plays the validation on the device; None where the processor does."""
        lanes = self._on_device(self.validation)
        return None if lanes is None else DevicePlayer(self.validation, lanes, self.algorithm, self.models)

    def _on_device(self, envs: MeteredEnv) -> DeviceLanes | None:
        """Return lanes as they are played on the device; None where that is not asked for, or cannot be."""
        spec = self.entry.task.environment
        if os.environ.get("QRLSUITE_CAPTURE") != "1":
            return None
        moves = spec.device is not None and self.statistics is None  # which each epoch replaces
        if not (moves and hasattr(self.algorithm, "choose")):
            part = self.entry.algorithm.title if moves else spec.title
            said = f"QRLSUITE_CAPTURE=1 has no effect: {part} takes no whole epochs to the device"
            self.progress.warnings += [said] if said not in self.progress.warnings else []
            return None
        lanes: DeviceLanes = specs.resolve(cast("str", spec.device))(envs.inner, self.device)
        return lanes

    @own.blamed()
    def start(self, initial: Arrays | None = None) -> None:
        """Begin at epoch 0: every training environment gets the stream that its seed and place determine.

        Parameters
        ----------
        initial:
            Trained agents to begin with, seed-first, as `policy` returns them. All else is fresh: optimizers, buffers,
            counters, and networks that do not act. Nothing of them, or None: as each seed draws its own.
        """
        if initial:
            self._build(self._places(initial))
        self.seed_environments()
        self.algorithm.start()

    def _places(self, initial: Arrays) -> dict[int, dict[str, torch.Tensor]]:
        """Return the numbers of trained agents by the network that they belong to, and their names there."""
        if self.statistics is not None:
            raise OptionError(
                f"'{self.entry.label}': observations of '{self.entry.task.name}' are standardized by running "
                "statistics, which training does not begin with: no agent to begin with is taken"
            )
        known = {
            tensor.data_ptr(): (call, name)
            for call, model in enumerate(self.models.built)
            for name, tensor in model.state_dict().items()
        }
        places: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in self.algorithm.policy_state().items():
            if not (tensor.is_floating_point() or tensor.is_complex()) or tensor.numel() == 0:
                continue  # counters begin anew
            if tensor.data_ptr() not in known:
                raise OptionError(
                    f"algorithm '{self.entry.algorithm.name}' keeps '{name}' outside of its networks: it cannot begin "
                    "with trained agents"
                )
            value = initial.get(name)
            if value is None or value.size != tensor.numel():
                raise StoreError(f"the agents to begin with do not fit the entry's model: '{name}'")
            call, place = known[tensor.data_ptr()]
            places.setdefault(call, {})[place] = torch.from_numpy(value).reshape(tensor.shape)
        return places

    def seed_environments(self) -> None:
        """Give every training environment its stream of epoch 0, from the beginning."""
        self.envs.seed_lanes([s.numpy("environment", lane) for s in self.streams for lane in range(self.E)])

    @own.blamed()
    def train_epoch(self) -> Epoch:
        """Train and validate one epoch."""
        before = self.models.executions()
        started, processor = time.perf_counter(), time.process_time()
        rounds = self.entry.task.file.protocol.rounds
        self._phase("training", rounds)
        if self.statistics is not None:
            self.statistics.adopt()
        if self._player is not None:
            self._player.drawn.begin(self.epoch + 1)
        with self._checks:
            metrics = dict(self.algorithm.train_epoch(rounds))
        metrics["train_return"], metrics["train_score"] = self._training_episodes()
        trained, between = time.perf_counter(), self.models.executions()
        self.progress.warnings += [p for p in self.models.problems() if p not in self.progress.warnings]
        episodes = self._validate(self.epoch + 1)
        finished, after = time.perf_counter(), self.models.executions()
        own_steps, played = episodes.lengths.reshape(self.S, self.V).sum(1), episodes.rounds * self.V
        executions = [
            {
                name: between[name] - before.get(name, 0) + (after[name] - between[name]) * steps // played
                for name in between
            }
            for steps in own_steps.tolist()
        ]
        self.progress.epoch_seconds = finished - started if self._warm else None
        self._warm = True
        seconds = {"train": trained - started, "validate": finished - trained}
        if self.device.type == "cpu":
            seconds["cpu"] = time.process_time() - processor
        self.epoch += 1
        scores = episodes.scores.reshape(self.S, self.V)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a mean of nothing is NaN
            measured = {
                name: np.nanmean(values.reshape(self.S, self.V), axis=1)
                for name, values in episodes.metrics.items()
            }
        diverged = self._diverged(metrics)
        return Epoch(self.epoch, metrics, scores, measured, executions, seconds, diverged)

    def _diverged(self, metrics: dict[str, Floats]) -> NDArray[np.bool_]:
        """Return, per seed, whether a number of its policy is not finite or a metric is infinite (NaN: no value)."""
        found = np.any([np.isinf(values) for values in metrics.values()], axis=0)
        for tensor in self.algorithm.policy_state().values():
            found |= ~torch.isfinite(tensor.detach()).reshape(self.S, -1).all(1).cpu().numpy()
        return np.asarray(found, np.bool_)

    def validate(self, epoch: int) -> Floats:
        """Play every seed's fresh validation episodes of an epoch; returns their scores (S, V).

        Circuit executions are counted by each seed's own steps, and the models' buffers, such as the number of passes
        with shots, are not changed: neither depends on the other seeds of the group.
        """
        return self._validate(epoch).scores.reshape(self.S, self.V)

    @own.blamed()
    def capture(self) -> Arrays:
        """Return a copy of everything that the rest of the training depends on, seed-first, by name."""
        arrays = {
            f"algorithm.{k}": v.detach().cpu().numpy().copy() for k, v in self.algorithm.state_dict().items()
        }
        for name, array in self.envs.state_dict().items():
            arrays[f"environment.{name}"] = array.reshape(self.S, self.E, *array.shape[1:]).copy()
        arrays["streams"] = pack(self.envs.inner.streams).reshape(self.S, self.E, -1)
        if self.statistics is not None:
            arrays |= {f"{PREFIX}{name}": array for name, array in self.statistics.state_dict().items()}
        return arrays

    @own.blamed()
    def restore(self, epoch: int, arrays: Arrays) -> None:
        """Continue after an epoch, from the result of `capture` at that epoch."""
        try:
            self.envs.inner.seed_lanes(unpack(arrays["streams"].reshape(self.S * self.E, -1)))
            lanes = {
                name: array.reshape(self.S * self.E, *array.shape[2:])
                for name, array in _part(arrays, "environment.").items()
            }
            self.envs.load_state_dict(lanes)
            state = _part(arrays, "algorithm.")
            self.algorithm.load_state_dict({k: torch.from_numpy(v.copy()) for k, v in state.items()})
            if self.statistics is not None:
                self.statistics.load_state_dict(_part(arrays, PREFIX))
        except (KeyError, ValueError, RuntimeError) as error:
            raise StoreError(f"the checkpoint does not fit: {own.failure(error)}") from error
        self.epoch = epoch

    @own.blamed()
    def policy(self) -> Arrays:
        """Return the parameters of the trained agents for publication, seed-first, by name."""
        tensors = self.algorithm.policy_state()
        if self.statistics is not None:
            tensors = {**tensors, **self.statistics.published()}
        return {name: value.detach().cpu().numpy() for name, value in tensors.items()}

    def _tick(self) -> None:
        self.progress.done += 1
        self.report(self.progress)

    def _phase(self, name: str, total: int) -> None:
        self.progress.phase, self.progress.done, self.progress.total = name, 0, total
        self.report(self.progress)

    def _training_episodes(self) -> tuple[Floats, Floats]:
        """Return mean return and score (S,) of the training episodes that ended in this epoch; NaN without any."""
        lanes, returns, scores = self.envs.take_finished()
        self.envs.take_metrics()
        owners = lanes // self.E
        counts = np.bincount(owners, minlength=self.S)
        with np.errstate(invalid="ignore"):
            means = [
                np.bincount(owners, weights=values, minlength=self.S) / counts for values in (returns, scores)
            ]
        return means[0], means[1]

    def _validate(self, epoch: int) -> Episodes:
        buffers = [buffer for model in self.models.built for buffer in model.buffers()]
        before = [buffer.clone() for buffer in buffers]
        self._phase("validating", self.progress.done if self.progress.phase == "validating" else 0)
        try:
            with self._checks:
                if self._player is not None:
                    episodes = self._player(epoch)
                else:
                    self.validation.seed_lanes(
                        [streams.numpy("validation", epoch) for streams in self.streams]
                    )
                    episodes = play_episodes(self.validation, lambda: self.act)
        finally:
            with torch.no_grad():
                for buffer, value in zip(buffers, before):
                    buffer.copy_(value)
        self._require_scores(episodes.scores)
        return episodes

    @own.blamed()
    def act(
        self,
        observations: NDArray[np.float32],
        begins: NDArray[np.bool_] | None = None,
        infos: Infos | None = None,
    ) -> NDArray[Any]:
        """Return the actions that the algorithm's `act` chooses, (S * L, ...), for observations (S * L, ...) of lanes.

        Parameters
        ----------
        begins:
            Where an episode begins with the observation (S * L,).
        infos:
            The lanes' infos on it.
        """
        stacked = np.ascontiguousarray(observations, np.float32)
        seen = stacked.reshape(self.S, len(stacked) // self.S, -1)
        told = _by_seed(infos or {}, *seen.shape[:2])
        more: tuple[Any, ...] = ()
        if self._informed and begins is None:
            optional = inspect.signature(self.algorithm.act).parameters["begins"].default is None
            if not optional or self._remembers:
                raise ValueError(
                    f"algorithm '{self.entry.algorithm.name}' remembers episodes: give act() where they begin"
                )
        if self._informed:
            more = None if begins is None else begins.reshape(seen.shape[:2]), told
        heeds = {"infos": told} if self._heeds and not self._informed else {}
        actions: NDArray[Any] = self.algorithm.act(seen, *more, **heeds)
        shape = *seen.shape[:2], *(self.envs.single_action_space.shape or ())
        if np.shape(actions) != shape:
            raise PluginError(
                f"algorithm '{self.entry.algorithm.name}': act returns the shape {np.shape(actions)}, and must return "
                f"{shape}, seeds and lanes first ({own.place_of(type(self.algorithm).act)})"
            )
        return actions.reshape(len(stacked), *shape[2:])

    def _require_scores(self, scores: Floats) -> None:
        """Refuse scores that no leaderboard would rank now, not after hours."""
        outside = scores[(scores < 0) | (scores > 1 + 1e-9)]
        if self.entry.task.file.ranking.thresholds is None and outside.size:
            raise EnvironmentFailure(
                f"environment '{self.entry.task.environment.name}': a validation episode has the score {outside[0]:g}, "
                "outside [0, 1]: is score.max_return in the task file the best possible return, and none negative?"
            )


def _by_seed(infos: Infos, seeds: int, lanes: int) -> dict[str, NDArray[Any]]:
    """Return the lanes' infos (S * L, ...) by seed (S, L, ...)."""
    return {
        name: value.reshape(seeds, lanes, *value.shape[1:])
        for name, value in infos.items()
        if isinstance(value, np.ndarray) and not name.startswith(("_", "final_"))
        if value.shape[:1] == (seeds * lanes,)
    }


def _part(arrays: Arrays, prefix: str) -> Arrays:
    """Return the arrays under a prefix, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
