"""Epochs on a GPU: rounds without a host read, captured as CUDA graphs, in environments that are tensors.

A *host read* is an operation whose result Python sees, such as `item()` or `if tensor:`. It waits until the GPU has
done all its work, and no graph can hold it.

With `QRLSUITE_CAPTURE=1` in the environment, tasks whose environment has a `device` are played as `DeviceLanes`, on any
device; on CUDA devices their rounds are captured. No GPU has shown yet that the bits stay, so it is off.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Drawn = TypeVar("Drawn")
_DRAWING = ThreadPoolExecutor(1, "draws ahead")

NUMERICS: dict[str, int] = {}
"""`numerics` of code that a GPU runs in the place of earlier code, by what it computes; set when it first runs."""


class LateChecks:
    """A block within which checks of numbers on a device are only noted there, and read once, at its end.

    One object serves all epochs of a training, since captured rounds write into its flags.
    """

    _open: ClassVar[LateChecks | None] = None

    def __init__(self) -> None:
        self._flags: dict[int, tuple[Tensor, Exception]] = {}

    def __enter__(self) -> None:
        LateChecks._open = self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        LateChecks._open = None
        for flag, error in self._flags.values():
            right = kind is not None or bool(flag)
            flag.fill_(True)
            if not right:
                raise error

    @classmethod
    def note(cls, owner: object, holds: Tensor, error: Exception) -> bool:
        """Note whether a check of `owner` holds, a bool on a device; return False where no block is open."""
        if cls._open is None:
            return False
        flags = cls._open._flags
        if id(owner) not in flags:
            flags[id(owner)] = torch.ones_like(holds), error
        flags[id(owner)][0].logical_and_(holds)
        return True


class DeviceLanes:
    """Plays ahead of an environment's lanes, by torch operations on a device (`EnvironmentSpec.device`).

    It changes nothing of the lanes, which make the same steps afterwards, by `actions`: they alone count episodes, draw
    from streams and are saved.

    Parameters
    ----------
    lanes:
        The environment; its `options.steps` are the most steps of an episode.
    device:
        Where the steps are computed.

    Attributes
    ----------
    state:
        Tensors on the device by name, which a step changes in place: `observations` (L, n) float32 to act on next,
        `round` (1,), which counts steps, and others.
    """

    def __init__(self, lanes: Any, device: torch.device) -> None:
        self.lanes, self.device = lanes, device
        self.state: dict[str, Tensor] = {}

    def draw(self, steps: int) -> dict[str, Any]:
        """Return arrays by name that so many steps need, from now on; nothing is done on the device."""
        raise NotImplementedError

    def act(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take a step in every lane, actions (L,) int64, without a host read.

        Returns
        -------
        tuple
            Observations before any reset (L, n), rewards (L,) float64, and whether episodes terminated (L,) bool.
        """
        raise NotImplementedError

    def begin(self, steps: int, drawn: dict[str, Any] | None = None) -> None:
        """Get ready for so many steps; `drawn` is a result of `draw`."""
        upload(self.state, self.device, **(self.draw(steps) if drawn is None else drawn))
        nothing = np.zeros((steps, self.lanes.num_envs), np.int64)
        upload(self.state, self.device, actions=nothing, round=nothing[0, :1])

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take a step as `act` does, and write the actions down."""
        self.state["actions"].index_copy_(0, self.state["round"], actions[None])
        self.state["round"] += 1
        return self.act(actions)

    def actions(self) -> NDArray[np.int64]:
        """Return the actions of all steps since `begin`, (steps, L)."""
        return self.state["actions"].cpu().numpy()


class EpisodesOnDevice(DeviceLanes):
    """Plays lanes whose episodes end by the agent's actions: a base for environments.

    The state is the lanes' `state_dict`, with `step` and `ended`. A lane may begin an episode after every step, so as
    many beginnings are drawn by lanes of the same kind, one for each, from copies of the streams.
    """

    def draw(self, steps: int) -> dict[str, Any]:
        """Return the state, and the beginnings of `steps` episodes for each lane."""
        lanes, count, drawn = self.lanes, self.lanes.num_envs, self.lanes.state_dict()
        self._names = list(drawn)
        if lanes.autoreset:
            more = type(lanes)(lanes.options, count * steps)
            more.seed_lanes(copy.deepcopy(lanes.streams))
            more.reset()
            drawn |= {
                f"start.{n}": v.reshape(count, steps, *v.shape[1:]) for n, v in more.state_dict().items()
            }
        return {**drawn, "begun": np.zeros(count, np.int64), "lane": np.arange(count)}

    def begin(self, steps: int, drawn: dict[str, Any] | None = None) -> None:
        """Get ready for so many steps."""
        super().begin(steps, drawn)
        upload(self.state, self.device, observations=self._seen())

    def act(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take a step in every lane; without `autoreset`, ended lanes stay where they are."""
        state, running = self.state, ~self.state["ended"]
        state["step"] += running
        rewards, ends = self._act(actions, running)
        last = (state["step"] >= self.lanes.options.steps) & running
        terminated = ends & running if getattr(self.lanes, "cut", True) else (ends & running) | last
        done, arrived = terminated | last, self._seen()
        state["ended"] |= done
        if self.lanes.autoreset:
            start = state["lane"], state["begun"].clamp(max=state["start.step"].shape[1] - 1)
            for name in self._names:
                now, shape = state[name], (-1, *[1] * (state[name].dim() - 1))
                now.copy_(torch.where(done.view(shape), state[f"start.{name}"][start], now))
            state["begun"] += done
        state["observations"].copy_(self._seen())
        return arrived, torch.where(running, rewards, 0.0), terminated

    def _act(self, actions: Tensor, running: Tensor) -> tuple[Tensor, Tensor]:
        """Change lanes that run, in place; return rewards, and whether episodes end before their last step."""
        raise NotImplementedError

    def _seen(self) -> Tensor:
        """Return every lane's observation (L, n), a new tensor."""
        raise NotImplementedError


def upload(state: dict[str, Tensor], device: torch.device, /, **values: Any) -> None:
    """Copy arrays or tensors into the ones of `state`, on a device; other memory is taken only where shapes change."""
    for name, value in values.items():
        new = torch.as_tensor(value)
        if name in state and state[name].shape == new.shape:
            state[name].copy_(new)
        else:
            state[name] = new.to(device, copy=True)


class Captured:
    """Does rounds: on a CUDA device, one is captured as a graph and replayed; elsewhere by plain calls.

    `round()` changes the tensors that `state()` returns, in place, and reads nothing from the device. Executions of the
    networks' circuits are counted.
    """

    def __init__(
        self, round: Callable[[], None], state: Callable[[], Mapping[str, Tensor]], *networks: nn.Module
    ) -> None:
        self._round, self._state = round, state
        counters = [getattr(each, "executions", None) for each in networks]
        self._counters = list({id(each): each for each in counters if each is not None}.values())
        self._graph: Any = None
        self._places: list[int] = []
        self._refused = False

    def __call__(self, rounds: int) -> None:
        """Do so many rounds. The graph is captured anew where tensors of the state have been replaced."""
        tensors = [each for each in self._state().values() if each.is_cuda]
        places = [each.data_ptr() for each in tensors]
        if not self._refused and places != self._places:
            self._places, self._graph = places, self._capture(tensors)
        if self._graph is None:
            for _ in range(rounds):
                self._round()
            return
        with torch.cuda.device(tensors[0].device):
            for _ in range(rounds):
                self._graph.replay()
        for counter, before, after in zip(self._counters, *self._executed):
            counter.forward += rounds * (after[0] - before[0])
            counter.gradient += rounds * (after[1] - before[1])

    def _counts(self) -> list[tuple[int, int]]:
        return [(each.forward, each.gradient) for each in self._counters]

    def _capture(self, tensors: list[Tensor]) -> Any:
        """Do two rounds on a side stream, for all that happens only once; capture a third, and undo the two."""
        kept, counts = [each.clone() for each in tensors], self._counts()
        graph: Any = torch.cuda.CUDAGraph()
        with torch.cuda.device(tensors[0].device):
            now, side = torch.cuda.current_stream(), torch.cuda.Stream()  # type: ignore[no-untyped-call]
            try:
                side.wait_stream(now)
                with torch.cuda.stream(side):
                    self._round()
                    self._round()
                now.wait_stream(side)
                before = self._counts()
                with torch.cuda.graph(graph):
                    self._round()
                self._executed = before, self._counts()
            except Exception as error:  # a plain round raises it again, if it is the round's own
                graph, self._refused = None, True
                print(
                    "qrlsuite: rounds cannot be captured as a CUDA graph, so they run one operation at a "
                    f"time: {error}",
                    file=sys.stderr,
                    flush=True,
                )
            torch.cuda.synchronize()
        for tensor, value in zip(tensors, kept):
            tensor.copy_(value)
        for counter, (forward, gradient) in zip(self._counters, counts):
            counter.forward, counter.gradient = forward, gradient
        return graph


class Ahead(Generic[Drawn]):
    """A function whose result depends on its arguments alone, computed in a thread before it is needed."""

    def __init__(self, function: Callable[..., Drawn]) -> None:
        self._function = function
        self._begun: dict[tuple[int, ...], Future[Drawn]] = {}

    def begin(self, *arguments: int) -> None:
        """Begin with the result for these arguments."""
        self._begun = {arguments: _DRAWING.submit(self._function, *arguments)}

    def __call__(self, *arguments: int) -> Drawn:
        """Return the result."""
        if arguments not in self._begun:
            self.begin(*arguments)
        return self._begun.pop(arguments).result()
