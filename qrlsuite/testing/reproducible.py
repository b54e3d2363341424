"""Rules of reproducible lanes: streams and actions alone decide observations and rewards."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from qrlsuite.environment import LaneEnv
from qrlsuite.seeding import pack, unpack
from qrlsuite.testing.findings import SIZES, BrokenRuleError, require
from qrlsuite.testing.lanes import LONGEST, E, Lanes, S, actions, differs, first_episodes, play, rows
from qrlsuite.training import questions
from qrlsuite.training.questions import STREAMS


def same_seed(lanes: Lanes, steps: int) -> None:
    """The same streams and actions give the same bits, in new and in used lanes."""
    questions.require_reproducible(lanes.make, lanes.spec)
    first = lanes.make([0, 1])
    action_rows = actions([0, 1], first.single_action_space, steps)
    play(first, action_rows)
    again = lanes.make([0, 1])
    for envs in (first, again):
        envs.seed_lanes([np.random.Generator(np.random.Philox(key=k)) for k in range(2 * E)])
    name = differs(play(first, action_rows), play(again, action_rows))
    require(name is None, f"a used environment, reset, shows other {name} than a new one: {STREAMS}")


def different_seed(lanes: Lanes) -> None:
    """Other streams give other episodes."""
    require(
        questions.drawn(lanes.make, lanes.spec) != "alike",
        f"all episodes are alike, whatever the stream: {STREAMS}; if that is meant, write repeats = True in the "
        "EnvironmentSpec, or in the class of a file",
    )


def seed_independence(lanes: Lanes, steps: int) -> None:
    """Seeds alone, in pairs and shuffled see the same as among all seeds."""
    envs = lanes.make(range(S))
    space = envs.single_action_space
    whole = play(envs, actions(range(S), space, steps))
    for members in SIZES:
        part = play(lanes.make(members), actions(members, space, steps))
        name = differs(part, {key: value[rows(members)] for key, value in whole.items()})
        require(
            name is None,
            f"seeds {list(members)} among themselves see other {name} than among all {S}: a lane may depend on its own "
            f"stream and actions alone; {STREAMS}",
        )


def state(lanes: Lanes, steps: int) -> None:
    """Saved in the middle of an episode, sliced, and restored in new lanes, episodes go on as they would have."""
    envs = lanes.make(range(S))
    action_rows = actions(range(S), envs.single_action_space, 2 * steps)
    play(envs, action_rows[: max(1, steps // 2)])
    saved = {}
    for name, value in envs.state_dict().items():
        require(
            isinstance(value, np.ndarray) and value.dtype.kind in "biuf",
            f"state '{name}' is {getattr(value, 'dtype', type(value).__name__)}, and checkpoints hold arrays of "
            "numbers: use np.array(...)",
        )
        require(
            value.ndim > 0 and value.shape[0] == S * E,
            f"state '{name}' of shape {value.shape} has no leading axis of {S * E} lanes: checkpoints are sliced",
        )
        saved[name] = value.copy()
    streams = pack(envs.streams)
    expected = play(envs, action_rows[steps:], reset=False)
    for members in (tuple(range(S)), (3,), (4, 1)):
        mine = rows(members)
        other = lanes.make(members)
        other.seed_lanes(unpack(streams[mine]))
        other.load_state_dict({name: value[mine].copy() for name, value in saved.items()})
        got = play(other, action_rows[steps:][:, mine], reset=False)
        lost = differs(got, {key: value[mine] for key, value in expected.items()})
        require(
            lost is None,
            f"restored from state_dict() in the middle of an episode, seeds {list(members)} see other {lost}: "
            "something that the rest of the episode depends on is not in the state, or is shared between lanes",
        )


def validation(lanes: Lanes) -> None:
    """Lanes play the same first episodes whether or not they are reset, and with any lanes beside them."""
    space = lanes.make([0]).single_action_space
    action_rows = actions(range(S), space, LONGEST)
    envs = lanes.make(range(S), autoreset=False, shared=True)
    length = _until_all_ended(envs, action_rows)
    whole = first_episodes(play(lanes.make(range(S), autoreset=False, shared=True), action_rows[:length]))
    for members in ((3,), (4, 1)):
        mine = rows(members)
        alone = lanes.make(members, autoreset=False, shared=True)
        part = first_episodes(play(alone, action_rows[:length, mine]))
        name = next((name for a, lane in zip(part, mine) if (name := differs(a, whole[lane]))), None)
        require(
            name is None,
            f"where a stream serves several lanes, seeds {list(members)} among themselves see other {name} than among "
            f"all {S}: lane l draws from self.streams[l * len(self.streams) // self.num_envs], and from no other",
        )
    with_reset = first_episodes(play(lanes.make(range(S)), action_rows[:length]))
    without = first_episodes(play(lanes.make(range(S), autoreset=False), action_rows[:length]))
    name = next((name for a, b in zip(with_reset, without) if (name := differs(a, b))), None)
    require(
        name is None,
        f"with autoreset = False the same streams and actions give other {name} in the first episode: a lane may "
        "depend on autoreset only after its end, and what infos hold is copied before the reset in the same step",
    )


def _until_all_ended(envs: LaneEnv, action_rows: NDArray[Any]) -> int:
    """Step lanes that are not reset until an episode ended in each, and on; return the number of steps."""
    envs.reset()
    over = np.zeros(envs.num_envs, dtype=bool)
    for step, row in enumerate(action_rows, start=1):
        _, _, terminated, truncated, _ = envs.step(row)
        over |= terminated | truncated
        if over.all():
            for _ in range(3):
                envs.step(row)
            return step
    raise BrokenRuleError(
        f"without autoreset, {np.count_nonzero(~over)} of {len(over)} lanes have not ended after "
        f"{len(action_rows)} steps of random actions: every episode "
        "needs a time limit, for validation waits until each lane has ended"
    )
