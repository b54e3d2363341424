"""One group of seeds: build, train epoch by epoch, validate, record, checkpoint.

A group is trained in one process on one thread. Killed at any moment and resumed, it ends with the same
curves and parameters, byte for byte, as one never stopped: everything that training depends on is in the
checkpoint or keyed by the epoch, and lines newer than the checkpoint are cut.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from qrlsuite import hidden, options, population, registry, specs
from qrlsuite.environment import LaneEnv
from qrlsuite.errors import EnvironmentFailure, StoreError
from qrlsuite.experiment.entry import Entry
from qrlsuite.results import checkpoint, provenance, store
from qrlsuite.seeding import Streams, pack, unpack
from qrlsuite.training.device import find as find_device
from qrlsuite.training.interrupts import Interruptible
from qrlsuite.training.metering import MeteredEnv
from qrlsuite.training.standardization import PREFIX, RunningStatistics
from qrlsuite.training.trackers import EventSink, asked

CHECKPOINT_SECONDS = 60.0
MAX_EPISODE_STEPS = 100_000
"""A validation episode that has not ended after so many steps is an error, not an endless loop."""


@dataclass
class Progress:
    """Where a group stands: what a progress display shows."""

    phase: str = "starting"
    epoch: int = 0
    epochs: int = 0
    done: int = 0
    """Rounds of the current phase done so far."""
    total: int = 0
    """Rounds of the current phase, 0 where unknown."""
    median_score: float | None = None
    seed_scores: list[float] = dataclasses.field(default_factory=list)
    """Each seed's score after `epoch`, for a median over all groups."""
    epoch_seconds: float | None = None
    warnings: list[str] = dataclasses.field(default_factory=list)
    """What the user should know although nothing failed: a tracker that was left out."""


Report = Callable[[Progress], None]


def build_envs(entry: Entry, lanes: int, tick: Callable[[], None]) -> MeteredEnv:
    """Build the task's environment with a number of lanes."""
    spec = entry.task.environment
    given = entry.task.environment_options
    inner: LaneEnv
    if spec.vector is not None:
        inner = specs.resolve(spec.vector)(given, lanes)
    else:
        from qrlsuite import register_environments
        from qrlsuite.gymlanes import GymLanes

        register_environments()
        inner = GymLanes(spec.gymnasium_id, lanes, dataclasses.asdict(given))
    return MeteredEnv(inner, spec.name, entry.task.file.score, tick)


class ModelBuilder:
    """Builds populations for an algorithm: every agent from its own seed's stream, every call from a new one.

    With `statistics`, all of them standardize their observations by these. A model that hides state from torch is
    refused (PluginError), see `qrlsuite.hidden`.
    """

    def __init__(
        self,
        entry: Entry,
        observation_size: int,
        streams: Sequence[Streams],
        statistics: RunningStatistics | None = None,
    ) -> None:
        self.entry = entry
        self.observation_size = observation_size
        self.streams = streams
        self.statistics = statistics
        self.built: list[nn.Module] = []
        self.parameters: list[tuple[int, int]] = []

    def __call__(self, out_dim: int) -> nn.Module:
        """Return a population of freshly initialized agents."""
        spec, given = self.entry.model, self.entry.model_options
        build = specs.resolve(spec.build)
        call = len(self.built)

        def agent(streams: Streams) -> nn.Module:
            made: nn.Module = build(self.observation_size, out_dim, given, streams.torch("init", call))
            return made

        first = self.streams[0]
        two = first, Streams(first.task_hash, first.seed + 1)
        hidden.require_none(lambda which: agent(two[which]), self.observation_size, spec.name)
        agents = [agent(streams) for streams in self.streams]
        self.parameters.append(population.count_parameters(agents[0]))
        if spec.population is None:
            together = population.stack(agents)
        else:
            together = specs.resolve(spec.population)(agents, given)
        if self.statistics is not None:
            self.statistics.attach(together)
        self.built.append(together)
        return together

    def problems(self) -> list[str]:
        """Say why populations run slower than they might; each reason once."""
        found = [getattr(module, "problem", None) for module in self.built]
        return list(dict.fromkeys(f"model '{self.entry.model.name}' {text}" for text in found if text))

    def executions(self) -> dict[str, int]:
        """Return each agent's circuit executions so far, summed over its networks; empty without circuits."""
        total: dict[str, int] = {}
        for module in self.built:
            counter = getattr(module, "executions", None)
            if counter is not None:
                for name, count in counter.as_dict().items():
                    total[name] = total.get(name, 0) + int(count)
        return total


class GroupRun:
    """The training of one group of seeds of an entry.

    Parameters
    ----------
    entry, entry_store:
        What to run, and its folder.
    seeds:
        Protocol seeds; all at the same epoch.
    epochs:
        The epoch at which to stop.
    device:
        Where the populations live: `cpu`, `cuda` or `cuda:1`.
    report:
        Called after every round with the group's progress.
    tracked:
        Whether trackers hear of it; not where seeds are trained again to compare them.

    Raises
    ------
    QrlSuiteError
        If the entry cannot be built, or there is no such device.
    """

    def __init__(
        self,
        entry: Entry,
        entry_store: store.EntryStore,
        seeds: Sequence[int],
        epochs: int,
        device: str = "cpu",
        report: Report = lambda progress: None,
        tracked: bool = True,
    ) -> None:
        torch.set_num_threads(1)
        self.entry, self.store, self.seeds, self.epochs = entry, entry_store, list(seeds), epochs
        self.report, self.device = report, device
        where = find_device(device)
        self.progress = Progress(epochs=epochs)
        self.streams = [Streams(entry.task.hash, seed) for seed in self.seeds]
        protocol = entry.task.file.protocol
        self.S, self.E, self.V = len(self.seeds), protocol.environments, protocol.validation_episodes
        self.envs = build_envs(entry, self.S * self.E, self._tick)
        self.validation = build_envs(entry, self.S * self.V, self._tick)
        self.validation.inner.autoreset = False
        size = int(np.prod(self.envs.single_observation_space.shape or (1,)))
        self.statistics: RunningStatistics | None = None
        if self.envs.inner.running_statistics:
            self.statistics = RunningStatistics(self.S, self.E, size, where)
            self.envs.observe = self.statistics.observe
        self.models = ModelBuilder(entry, size, self.streams, self.statistics)
        factory = specs.resolve(entry.algorithm.factory)
        self.algorithm = factory(self.envs, self.models, entry.algorithm_options, self.streams, where)
        self.epoch = 0
        self.events = EventSink(registry.load(), asked()) if tracked else EventSink(None)
        self.progress.warnings = self.events.problems
        self.validation_steps = np.zeros(self.S, np.int64), 1
        self._saved_epoch = -1
        self._snapshot: tuple[int, checkpoint.Arrays] | None = None

    def run(self) -> None:
        """Train to the last epoch; on an interruption, save the last finished epoch and raise it again.

        Raises
        ------
        KeyboardInterrupt
            After an interruption, with everything saved.
        EnvironmentFailure, StoreError
            If the environment raises, or results cannot be written; finished epochs stay.
        """
        with Interruptible() as guard:
            try:
                with guard.deferred():
                    self._begin()
                last_save = time.monotonic()
                while self.epoch < self.epochs:
                    record = self._one_epoch()
                    with guard.deferred():
                        self._record(*record)
                        self._snapshot = (self.epoch, self._capture())
                        if time.monotonic() - last_save >= CHECKPOINT_SECONDS or self.epoch == self.epochs:
                            self._save()
                            last_save = time.monotonic()
                with guard.deferred():
                    self._finish()
            except (KeyboardInterrupt, EnvironmentFailure):
                with guard.deferred():
                    self._save()
                raise

    def _tick(self) -> None:
        self.progress.done += 1
        self.report(self.progress)

    def _phase(self, name: str, total: int) -> None:
        self.progress.phase, self.progress.done, self.progress.total = name, 0, total
        self.report(self.progress)

    def _begin(self) -> None:
        """Start fresh, or resume from the newest checkpoint; cut what is newer than it."""
        epoch, arrays = checkpoint.load(self.store, self.seeds)
        for seed in self.seeds:
            folder = self.store.seed(seed)
            old = folder.record() or {}
            if epoch < int(old.get("epochs", 0)) and old.get("status") == "finished":
                raise StoreError(
                    f"{folder.path} finished {old['epochs']} epochs and its checkpoint is gone: it cannot be "
                    "extended; choose another folder with --runs DIR, or delete the seed's folder to start again"
                )
            if (held := folder.cut(epoch)) < epoch:
                raise StoreError(
                    f"{folder.path} holds {held} epochs, its checkpoint {epoch}: restore the file, or delete the "
                    "seed's folder to start again"
                )
        if epoch:
            self._restore(epoch, arrays)
        else:
            self.begin_episodes()
            self.algorithm.start()
        self.progress.epoch = self.epoch
        origin = provenance.collect(self.entry.distributions(), find_device(self.device))
        for seed in self.seeds:
            folder = self.store.seed(seed)
            old = folder.record() or {}
            made_with = [*old.get("provenance", [])]
            if origin not in made_with:
                made_with.append(origin)
            record = {
                **self._seed_record(seed),
                "status": "running",
                "epochs": self.epoch,
                "provenance": made_with,
            }
            folder.write_record(record)
            self.events.send("run_started", run={**record, "folder": str(folder.path)})

    def begin_episodes(self) -> None:
        """Give every training environment the stream that its seed and place determine."""
        self.envs.seed_lanes([s.numpy("environment", lane) for s in self.streams for lane in range(self.E)])

    def _seed_record(self, seed: int) -> dict[str, Any]:
        classical, quantum = self.models.parameters[0]
        return {
            "task": self.entry.task.name,
            "task_hash": self.entry.task.hash,
            "entry": self.entry.name,
            "label": self.entry.label,
            "algorithm": self.entry.algorithm.name,
            "algorithm_options": options.plain(self.entry.algorithm_options),
            "model": self.entry.model.name,
            "family": self.entry.model.family,
            "model_options": options.plain(self.entry.model_options),
            "parameters": {"classical": classical, "quantum": quantum},
            "seed": seed,
            "interactions_per_epoch": self.entry.task.file.protocol.interactions,
        }

    def _one_epoch(
        self,
    ) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64], list[dict[str, int]], dict[str, float]]:
        """Train and validate one epoch; returns metrics, scores (S, V), each seed's executions, and seconds."""
        before = self.models.executions()
        started, processor = time.perf_counter(), time.process_time()
        self._phase("training", self.entry.task.file.protocol.rounds)
        if self.statistics is not None:
            self.statistics.adopt()
        metrics = dict(self.algorithm.train_epoch(self.entry.task.file.protocol.rounds))
        metrics["train_return"], metrics["train_score"] = self._training_episodes()
        trained, between = time.perf_counter(), self.models.executions()
        self.progress.warnings += [p for p in self.models.problems() if p not in self.progress.warnings]
        scores = self.validate(self.epoch + 1)
        finished, after = time.perf_counter(), self.models.executions()
        own_steps, played = self.validation_steps
        executions = [
            {
                name: between[name] - before.get(name, 0) + (after[name] - between[name]) * steps // played
                for name in between
            }
            for steps in own_steps.tolist()
        ]
        self.progress.epoch_seconds = finished - started
        seconds = {"train": trained - started, "validate": finished - trained}
        if self.device == "cpu":
            seconds["cpu"] = time.process_time() - processor
        return metrics, scores, executions, seconds

    def _training_episodes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mean return and score (S,) of the training episodes that ended in this epoch; NaN without any."""
        lanes, returns, scores = self.envs.take_finished()
        owners = lanes // self.E
        counts = np.bincount(owners, minlength=self.S)
        with np.errstate(invalid="ignore"):
            means = [
                np.bincount(owners, weights=values, minlength=self.S) / counts for values in (returns, scores)
            ]
        return means[0], means[1]

    def validate(self, epoch: int) -> NDArray[np.float64]:
        """Play every seed's fresh greedy episodes of an epoch; returns their scores (S, V).

        All lanes go on until the last episode of the group has ended. `validation_steps` then holds each seed's
        steps within its episodes (S,), and the steps that each seed's lanes made in all: executions are counted by
        the former, so that they do not depend on the company a seed is trained in. Nor does what follows: the models'
        buffers, such as how many passes with shots there were, are left as they were.
        """
        buffers = [buffer for model in self.models.built for buffer in model.buffers()]
        before = [buffer.clone() for buffer in buffers]
        try:
            return self._play(epoch)
        finally:
            with torch.no_grad():
                for buffer, value in zip(buffers, before):
                    buffer.copy_(value)

    def _play(self, epoch: int) -> NDArray[np.float64]:
        """Do what `validate` says, but for the models' buffers."""
        envs = self.validation
        self._phase("validating", self.progress.done if self.progress.phase == "validating" else 0)
        envs.seed_lanes([streams.numpy("validation", epoch) for streams in self.streams])
        envs.take_finished()
        observations, _ = envs.reset()
        scores = np.full(envs.num_envs, np.nan)
        open_lanes = np.ones(envs.num_envs, dtype=bool)
        own_steps = np.zeros(self.S, np.int64)
        for played in range(1, MAX_EPISODE_STEPS + 1):
            own_steps += open_lanes.reshape(self.S, self.V).sum(1)
            stacked = np.ascontiguousarray(observations, np.float32).reshape(self.S, self.V, -1)
            actions = self.algorithm.act(stacked).reshape(-1)
            observations, _, terminated, truncated, _ = envs.step(actions)
            if (terminated | truncated).any():
                lanes, _, given = envs.take_finished()
                first = open_lanes[lanes]
                scores[lanes[first]] = given[first]
                open_lanes[lanes] = False
                if not open_lanes.any():
                    self.validation_steps = own_steps, played * self.V
                    self._require_scores(scores)
                    return scores.reshape(self.S, self.V)
        raise EnvironmentFailure(
            f"environment '{self.entry.task.environment.name}': a validation episode did not end within "
            f"{MAX_EPISODE_STEPS} steps; give it a time limit"
        )

    def _require_scores(self, scores: NDArray[np.float64]) -> None:
        """Refuse scores that no leaderboard would rank now, not after hours."""
        outside = scores[(scores < 0) | (scores > 1 + 1e-9)]
        if self.entry.task.file.ranking.thresholds is None and outside.size:
            raise EnvironmentFailure(
                f"environment '{self.entry.task.environment.name}': a validation episode has the score {outside[0]:g}, "
                "outside [0, 1]: is score.max_return in the task file the best possible return, and none negative?"
            )

    def _record(
        self,
        metrics: dict[str, NDArray[np.float64]],
        scores: NDArray[np.float64],
        executions: list[dict[str, int]],
        seconds: dict[str, float],
    ) -> None:
        """Append one line per seed, and tell the trackers."""
        self.epoch += 1
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        for s, seed in enumerate(self.seeds):
            folder = self.store.seed(seed)
            line: dict[str, Any] = {"epoch": self.epoch, "scores": store.shortest(scores[s])}
            for name, values in metrics.items():
                value = float(values[s])
                line[name] = value if math.isfinite(value) else None
            if executions[s]:
                line["executions"] = executions[s]
            store.append(folder.lines, store.json_line(line))
            timing = {name: round(value / self.S, 6) for name, value in seconds.items()}
            store.append(
                folder.timings,
                store.json_line(
                    {
                        "epoch": self.epoch,
                        **timing,
                        "group": self.S,
                        "host": socket.gethostname(),
                        "time": now,
                    }
                ),
            )
            run = {**self._seed_record(seed), "folder": str(folder.path)}
            self.events.send("epoch_finished", run=run, record=line)
        self.progress.epoch = self.epoch
        self.progress.seed_scores = scores.mean(axis=1).tolist()
        self.progress.median_score = float(np.median(self.progress.seed_scores))
        self.report(self.progress)

    def _capture(self) -> checkpoint.Arrays:
        """Copy everything that the rest of the run depends on, seed-first."""
        arrays = {
            f"algorithm.{k}": v.detach().cpu().numpy().copy() for k, v in self.algorithm.state_dict().items()
        }
        for name, array in self.envs.state_dict().items():
            arrays[f"environment.{name}"] = array.reshape(self.S, self.E, *array.shape[1:]).copy()
        arrays["streams"] = pack(self.envs.inner.streams).reshape(self.S, self.E, -1)
        if self.statistics is not None:
            arrays |= {f"{PREFIX}{name}": array for name, array in self.statistics.state_dict().items()}
        return arrays

    def _restore(self, epoch: int, arrays: checkpoint.Arrays) -> None:
        """Continue from captured arrays.

        Raises
        ------
        StoreError
            If they do not fit this entry.
        """
        try:
            self.envs.inner.seed_lanes(unpack(arrays["streams"].reshape(self.S * self.E, -1)))
            self.envs.load_state_dict(
                {
                    name.removeprefix("environment."): array.reshape(self.S * self.E, *array.shape[2:])
                    for name, array in arrays.items()
                    if name.startswith("environment.")
                }
            )
            state = {
                name.removeprefix("algorithm."): torch.from_numpy(array.copy())
                for name, array in arrays.items()
                if name.startswith("algorithm.")
            }
            self.algorithm.load_state_dict(state)
            if self.statistics is not None:
                self.statistics.load_state_dict(
                    {
                        name.removeprefix(PREFIX): array
                        for name, array in arrays.items()
                        if name.startswith(PREFIX)
                    }
                )
        except (KeyError, ValueError, RuntimeError) as error:
            raise StoreError(
                f"{self.store.path}: its checkpoint does not fit this version: {error}"
            ) from error
        self.epoch = epoch
        self._saved_epoch = epoch

    def _save(self) -> None:
        """Write the checkpoint of the last finished epoch, if it is newer than the one on disk."""
        if self._snapshot is None or self._snapshot[0] <= self._saved_epoch:
            return
        epoch, arrays = self._snapshot
        for seed in self.seeds:
            self.store.seed(seed).sync()
        checkpoint.save(self.store, self.seeds, epoch, arrays)
        self._saved_epoch = epoch

    def _finish(self) -> None:
        """Publish the trained agents, compact the lines, and mark every seed as finished."""
        from safetensors.numpy import save as encode

        tensors = self.algorithm.policy_state()
        if self.statistics is not None:
            tensors = {**tensors, **self.statistics.published()}
        policy = {name: value.detach().cpu().numpy() for name, value in tensors.items()}
        for s, seed in enumerate(self.seeds):
            folder = self.store.seed(seed)
            agent = {name: np.ascontiguousarray(array[s]) for name, array in policy.items()}
            store.write_atomically(folder.path / "final.safetensors", encode(agent))
            folder.compact()
            record = {
                **(folder.record() or self._seed_record(seed)),
                "status": "finished",
                "epochs": self.epoch,
            }
            del record["format_version"]
            folder.write_record(record)
            self.events.send("run_finished", run={**record, "folder": str(folder.path)})
        self.progress.phase = "finished"
        self.report(self.progress)
