"""Learning on CartPole at equal settings, beside Stable-Baselines3, SBX, rejax, CleanRL's SAC, JAX and plain torch.

    pip install '.[bench]'
    python benchmarks/learning.py [--algorithms ddqn ppo sac] [--seeds 10] [--epochs 100] [--json out.json]

Every agent has the same network, learning rate, discount, batch, replay buffer, target updates, exploration and
gradient steps per interaction; it learns from 10 environments, and every 1000 interactions it plays the same 100
greedy episodes as its peers. Settings of DDQN and PPO are those of the task's preset `tuned`, but for PPO's
minibatches: 50 divides 1000 samples, so that both make equally many. What Stable-Baselines3 does otherwise by default
is switched to what the suite does: no clipping of gradients, constant exploration, no warm-up, ReLU and torch's own
initialization, Adam's eps 1e-8. Two differences remain in its DQN and cannot be switched: targets are not double, and
the error is Huber's; with several environments it also flips one coin for all of them where the suite flips one each.
The third row, `SB3 DQN, our update`, is the same class with these three replaced, as the suite has them.
`JAX, jit and vmap` is the same loop in `jax_ddqn.py`, with every seed and the environment in one compiled epoch, as in
rejax's PPO, which clips the loss of its values and has flax's initialization. SBX is SB3 in JAX, one seed at a time.
Compilation is not counted. `torch, one seed` is the loop in the manner of CleanRL's single files.

Discrete SAC (Christodoulou 2019) is held to the equations of CleanRL's `sac_atari.py` (commit 004f8a0), written out
here for CartPole's network: the loss of its temperature is linear in alpha and not in log alpha, means of the actor's
and the temperature's losses run over actions too, and one Adam serves both critics. Two gradient steps follow every
step of the 10 environments, the learning rate is 1e-3, the target entropy 0.5 log 2, the copies follow by 0.005 a
step, and 1000 uniform interactions come first. CleanRL's own settings are Atari's: 0.89 log n, and copies every 8000
steps.

Printed are medians over seeds and, in brackets, their 5th to 95th bootstrap percentiles (whole runs resampled, 10,000
times): interactions until a mean score first reaches 0.5 and 0.95 of the optimum, the mean score of the whole curve,
the score at the end, and seconds of processor time per seed spent on learning, without evaluation. Differences are
ours minus theirs. One thread; all 10 seeds of the suite are trained together, those of its peer one after another.
"""

from __future__ import annotations

import argparse
import copy
import functools
import itertools
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.seeding import Streams
from qrlsuite.specs import resolve as reference
from qrlsuite.training.trainer import ModelBuilder, build_envs

FloatArray = NDArray[np.float64]
Act = Callable[[NDArray[np.float32]], NDArray[np.int64]]
EPISODES, ENVIRONMENTS, INTERACTIONS = 100, 10, 1000
THRESHOLDS: tuple[float, ...] = (0.5, 0.95)
SETTINGS = {
    "ddqn": [],
    "ppo": ["batch=50"],
    "sac": ["lr=1e-3", "batch=64", "updates=2", "warm_up=1000", f"target_entropy={0.5 * np.log(2):.6f}"],
}


class Runs:
    """The runs of one implementation.

    Attributes
    ----------
    scores:
        Mean score of the greedy episodes after every epoch, (seeds, epochs).
    seconds:
        Processor time of learning per seed.
    """

    def __init__(self, name: str, scores: FloatArray, seconds: float) -> None:
        self.name, self.scores, self.seconds = name, scores, seconds

    def measures(self) -> dict[str, FloatArray]:
        """Return each measure per seed; a threshold never reached counts as one epoch more than there are."""
        reached = {
            f"steps to {t:g}": INTERACTIONS
            * (1.0 + np.where((self.scores >= t).any(1), (self.scores >= t).argmax(1), self.scores.shape[1]))
            for t in THRESHOLDS
        }
        return {**reached, "mean score": self.scores.mean(1), "final score": self.scores[:, -1]}


def ours(entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train a population."""
    streams = [Streams(entry.task.hash, seed) for seed in seeds]
    envs = build_envs(entry, ENVIRONMENTS * len(seeds), lambda: None)
    envs.seed_lanes([s.numpy("environment", lane) for s in streams for lane in range(ENVIRONMENTS)])
    agents = reference(entry.algorithm.factory)(
        envs, ModelBuilder(entry, envs, streams), entry.algorithm_options, streams, torch.device("cpu")
    )
    agents.start()
    play = Evaluation(entry, streams)
    seconds, scores = 0.0, []
    for epoch in range(epochs):
        begun = time.process_time()
        agents.train_epoch(INTERACTIONS // ENVIRONMENTS)
        seconds += time.process_time() - begun
        scores.append(play(agents.act, epoch + 1))
    return Runs(f"qrlsuite {entry.algorithm.name}", np.stack(scores, axis=1), seconds / len(seeds))


def theirs(name: str, make: Callable[[Any, int], Any], entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train a peer's agents one by one; `make` builds one from its environments and a seed."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    def begin(seed: int) -> Any:
        return make(DummyVecEnv([lambda: gymnasium.make("CartPole-v1")] * ENVIRONMENTS), seed)

    begin(0).learn(INTERACTIONS, reset_num_timesteps=False)  # what is compiled, is compiled here
    seconds, curves = 0.0, []
    for seed in seeds:
        play = Evaluation(entry, [Streams(entry.task.hash, seed)])
        agent = begin(seed)

        def act(observations: NDArray[np.float32], agent: Any = agent) -> NDArray[np.int64]:
            actions, _ = agent.predict(observations[0], deterministic=True)
            return np.asarray(actions)[None]

        scores = []
        for epoch in range(epochs):
            begun = time.process_time()
            agent.learn(INTERACTIONS, reset_num_timesteps=False)
            seconds += time.process_time() - begun
            scores.append(float(play(act, epoch + 1)[0]))
        curves.append(scores)
    return Runs(name, np.array(curves), seconds / len(seeds))


class Evaluation:
    """Plays the task's greedy validation episodes of some seeds."""

    def __init__(self, entry: Entry, streams: list[Streams]) -> None:
        self.streams = streams
        self.envs = build_envs(entry, EPISODES * len(streams), lambda: None)
        self.envs.inner.autoreset = False

    def __call__(self, act: Act, epoch: int) -> FloatArray:
        """Return the mean score of each seed's episodes of an epoch (seeds,)."""
        lanes = EPISODES * len(self.streams)
        self.envs.seed_lanes([s.numpy("validation", epoch) for s in self.streams])
        observations, _ = self.envs.reset()
        returns, running = np.zeros(lanes), np.ones(lanes, dtype=np.bool_)
        while running.any():
            stacked = np.ascontiguousarray(observations, np.float32).reshape(len(self.streams), EPISODES, -1)
            observations, rewards, terminated, truncated, _ = self.envs.step(act(stacked).reshape(-1))
            returns += np.where(running, rewards, 0.0)
            running &= ~(terminated | truncated)
        scores: FloatArray = returns.reshape(len(self.streams), EPISODES).mean(1) / 500.0
        return scores


def sb3_dqn(entry: Entry, equal: bool) -> Callable[[Any, int], Any]:
    """Return a maker of DQN agents at an entry's settings; `equal` also replaces what cannot be switched."""
    from stable_baselines3 import DQN
    from torch.nn import functional

    class OurUpdate(DQN):
        """Double targets, squared error, a coin per environment."""

        def train(self, gradient_steps: int, batch_size: int = 100) -> None:
            for _ in range(gradient_steps):
                data = self.replay_buffer.sample(batch_size)  # type: ignore[union-attr]
                with torch.no_grad():
                    best = self.q_net(data.next_observations).argmax(1, keepdim=True)
                    following = self.q_net_target(data.next_observations).gather(1, best)
                    target = data.rewards + (1 - data.dones) * self.gamma * following
                loss = functional.mse_loss(self.q_net(data.observations).gather(1, data.actions), target)
                self.policy.optimizer.zero_grad()
                loss.backward()
                self.policy.optimizer.step()

        def predict(
            self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
        ) -> Any:
            actions, state = self.policy.predict(observation, state, episode_start, deterministic)
            if not deterministic:
                drawn = np.random.rand(len(actions)) < self.exploration_rate  # noqa: NPY002
                actions = np.where(drawn, np.random.randint(2, size=len(actions)), actions)  # noqa: NPY002
            return actions, state

    o, network = entry.algorithm_options, entry.model_options

    def make(environments: Any, seed: int) -> Any:
        return (OurUpdate if equal else DQN)(
            "MlpPolicy",
            environments,
            learning_rate=o.lr,
            buffer_size=o.buffer,
            learning_starts=0,
            batch_size=o.batch,
            gamma=o.gamma,
            train_freq=1,  # a step of all environments
            gradient_steps=1,
            target_update_interval=o.target_steps * ENVIRONMENTS,  # counted in interactions
            exploration_initial_eps=o.epsilon,
            exploration_final_eps=o.epsilon,
            max_grad_norm=float("inf"),
            policy_kwargs={"net_arch": [network.width] * network.depth, "activation_fn": torch.nn.ReLU},
            seed=seed,
            device="cpu",
        )

    return make


class PlainDDQN:
    """One agent in plain torch, in the manner of CleanRL's single files: Gymnasium's vector, one network, one loop."""

    def __init__(self, entry: Entry, environments: Any, seed: int) -> None:
        self.o, self.envs, self.rng = entry.algorithm_options, environments, np.random.default_rng(seed)
        torch.manual_seed(seed)
        sizes = [4, *[entry.model_options.width] * entry.model_options.depth, 2]
        layers: list[torch.nn.Module] = []
        for i, o in itertools.pairwise(sizes):
            layers += [torch.nn.Linear(i, o), torch.nn.ReLU()]
        self.online = torch.nn.Sequential(*layers[:-1])
        self.target = copy.deepcopy(self.online)
        self.adam = torch.optim.Adam(self.online.parameters(), self.o.lr)
        self.buffer, self.stored, self.updates = np.zeros((self.o.buffer, 11), np.float32), 0, 0
        self.observations = environments.reset()

    def learn(self, interactions: int, reset_num_timesteps: bool) -> None:
        """Interact and learn."""
        o, n = self.o, self.envs.num_envs
        for _ in range(interactions // n):
            with torch.no_grad():
                actions = self.online(torch.from_numpy(self.observations)).argmax(1).numpy()
            actions = np.where(self.rng.random(n) < o.epsilon, self.rng.integers(2, size=n), actions)
            after, rewards, over, infos = self.envs.step(actions)
            arrived = np.array([infos[i].get("terminal_observation", after[i]) for i in range(n)], np.float32)
            alive = [not over[i] or infos[i]["TimeLimit.truncated"] for i in range(n)]
            rows = [self.observations, arrived, actions[:, None], rewards[:, None], np.array(alive)[:, None]]
            self.buffer[(self.stored + np.arange(n)) % o.buffer] = np.concatenate(rows, 1)
            self.stored, self.observations = self.stored + n, after
            picked = self.rng.integers(min(self.stored, o.buffer), size=o.batch)
            batch = torch.from_numpy(self.buffer[picked])
            following, chosen = batch[:, 4:8], batch[:, 8:9].long()
            with torch.no_grad():
                best = self.online(following).argmax(1, keepdim=True)
                y = batch[:, 9:10] + o.gamma * batch[:, 10:11] * self.target(following).gather(1, best)
            loss = torch.nn.functional.mse_loss(self.online(batch[:, :4]).gather(1, chosen), y)
            self.adam.zero_grad()
            loss.backward()
            self.adam.step()
            self.updates += 1
            if self.updates % o.target_steps == 0:
                self.target.load_state_dict(self.online.state_dict())

    def predict(self, observations: NDArray[np.float32], deterministic: bool) -> tuple[Any, None]:
        """Return greedy actions."""
        with torch.no_grad():
            return self.online(torch.from_numpy(observations)).argmax(1).numpy(), None


def by_jax(entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train JAX's agents together, see `jax_ddqn`; compilation is not counted."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    import jax_ddqn

    assert jax_ddqn.check() < 1e-5, "JAX's CartPole is another one"
    o, model = entry.algorithm_options, entry.model_options
    settings = jax_ddqn.Settings(
        width=model.width,
        depth=model.depth,
        lr=o.lr,
        gamma=o.gamma,
        epsilon=o.epsilon,
        buffer=o.buffer,
        batch=o.batch,
        target_steps=o.target_steps,
        environments=ENVIRONMENTS,
        rounds=INTERACTIONS // ENVIRONMENTS,
    )
    begin, epoch, act = jax_ddqn.compiled(settings)
    return _together("JAX, jit and vmap", entry, seeds, epochs, (begin, epoch, act))


def _together(name: str, entry: Entry, seeds: range, epochs: int, functions: tuple[Any, Any, Any]) -> Runs:
    """Train agents that begin, learn an epoch and act by compiled functions; compilation is not counted."""
    import jax

    begin, epoch, act = functions
    keys = jax.vmap(jax.random.key)(np.array(seeds))
    jax.block_until_ready(epoch(begin(keys)))  # compiles
    agents = begin(keys)
    play = Evaluation(entry, [Streams(entry.task.hash, seed) for seed in seeds])
    seconds, scores = 0.0, []
    for number in range(epochs):
        begun = time.process_time()
        agents = jax.block_until_ready(epoch(agents))
        seconds += time.process_time() - begun
        scores.append(play(lambda x, agents=agents: np.asarray(act(agents, x)), number + 1))
    return Runs(name, np.stack(scores, axis=1), seconds / len(seeds))


def by_rejax(entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train rejax's PPO, all agents and their environments (gymnax's CartPole) in one compiled epoch."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    import jax
    import rejax

    o, network = entry.algorithm_options, entry.model_options
    ppo = rejax.PPO.create(
        env="CartPole-v1",
        num_envs=ENVIRONMENTS,
        num_steps=INTERACTIONS // ENVIRONMENTS,
        num_minibatches=INTERACTIONS // o.batch,
        num_epochs=o.repeats,
        total_timesteps=INTERACTIONS * epochs,
        learning_rate=o.lr,
        gamma=o.gamma,
        gae_lambda=o.gae_lambda,
        clip_eps=o.clip,
        ent_coef=o.entropy_coefficient,
        vf_coef=o.value_coefficient,
        max_grad_norm=float("inf"),
        agent_kwargs={"hidden_layer_sizes": (network.width,) * network.depth, "activation": "relu"},
    )

    def act(agent: Any, x: Any) -> Any:
        return ppo.actor.apply(agent.actor_ts.params, x, method="_action_dist").mode()

    each = (ppo.init_state, ppo.train_iteration, act)
    return _together("rejax PPO", entry, seeds, epochs, tuple(jax.jit(jax.vmap(f)) for f in each))


def sb3_ppo(entry: Entry, jax: bool = False) -> Callable[[Any, int], Any]:
    """Return a maker of PPO agents at an entry's settings, of SB3's, or of SBX's, which is SB3 in JAX."""
    if jax:
        from flax.linen import relu
        from sbx import PPO
    else:
        from stable_baselines3 import PPO

        relu = torch.nn.ReLU
    o, network = entry.algorithm_options, entry.model_options
    layers = [network.width] * network.depth

    def make(environments: Any, seed: int) -> Any:
        return PPO(
            "MlpPolicy",
            environments,
            learning_rate=o.lr,
            n_steps=INTERACTIONS // ENVIRONMENTS,
            batch_size=o.batch,
            n_epochs=o.repeats,
            gamma=o.gamma,
            gae_lambda=o.gae_lambda,
            clip_range=o.clip,
            normalize_advantage=True,
            ent_coef=o.entropy_coefficient,
            vf_coef=o.value_coefficient,
            max_grad_norm=float("inf"),
            policy_kwargs={
                "net_arch": {"pi": layers, "vf": layers},
                "activation_fn": relu,
                "ortho_init": False,
                "optimizer_kwargs": {"eps": 1e-8},
            },
            seed=seed,
            device="cpu",
        )

    return make


class CleanSAC:
    """One agent by the equations of CleanRL's discrete SAC, with the methods that `theirs` calls."""

    def __init__(self, entry: Entry, environments: Any, seed: int) -> None:
        torch.manual_seed(seed)
        self.o, self.environments = entry.algorithm_options, environments
        self.random = np.random.default_rng(seed)
        width, depth = entry.model_options.width, entry.model_options.depth
        self.actor, *critics = (self._network(width, depth) for _ in range(3))
        self.critics = torch.nn.ModuleList(critics)
        self.targets = copy.deepcopy(self.critics)
        self.log_alpha = torch.zeros(1, requires_grad=True)
        self.adams = [
            torch.optim.Adam(parameters, lr=self.o.lr)
            for parameters in (self.critics.parameters(), self.actor.parameters(), [self.log_alpha])
        ]
        self.rows = np.zeros((self.o.buffer, 11), np.float32)  # state, arrived, action, reward, terminated
        self.stored = 0
        self.seen = environments.reset()

    @staticmethod
    def _network(width: int, depth: int) -> torch.nn.Module:
        sizes = [4, *[width] * depth]
        layers = [[torch.nn.Linear(*pair), torch.nn.ReLU()] for pair in itertools.pairwise(sizes)]
        return torch.nn.Sequential(*itertools.chain(*layers), torch.nn.Linear(width, 2))

    def predict(self, observations: Any, deterministic: bool) -> tuple[NDArray[np.int64], None]:
        """Return the most probable actions."""
        with torch.no_grad():
            return self.actor(torch.as_tensor(observations)).argmax(1).numpy(), None

    def learn(self, interactions: int, reset_num_timesteps: bool) -> None:
        """Interact and learn."""
        for _ in range(interactions // ENVIRONMENTS):
            if self.stored < self.o.warm_up:
                actions = self.random.integers(2, size=ENVIRONMENTS)
            else:
                with torch.no_grad():
                    logits = self.actor(torch.as_tensor(self.seen))
                actions = torch.distributions.Categorical(logits=logits).sample().numpy()
            after, rewards, done, infos = self.environments.step(actions)
            arrived, cut = after.copy(), np.zeros(ENVIRONMENTS, np.bool_)
            for lane in np.flatnonzero(done):
                arrived[lane] = infos[lane]["terminal_observation"]
                cut[lane] = infos[lane]["TimeLimit.truncated"]
            places = (self.stored + np.arange(ENVIRONMENTS)) % len(self.rows)
            self.rows[places] = np.column_stack([self.seen, arrived, actions, rewards, done & ~cut])
            self.stored, self.seen = self.stored + ENVIRONMENTS, after
            for _ in range(self.o.updates if self.stored >= self.o.warm_up else 0):
                self._update()

    def _step(self, which: int, loss: torch.Tensor) -> None:
        self.adams[which].zero_grad()
        loss.backward()
        self.adams[which].step()

    def _update(self) -> None:
        picked = self.random.integers(min(self.stored, len(self.rows)), size=self.o.batch)
        rows = torch.as_tensor(self.rows[picked])
        states, arrived, action = rows[:, :4], rows[:, 4:8], rows[:, 8].long()[:, None]
        alpha = self.log_alpha.exp().item()
        with torch.no_grad():
            log_pi = torch.log_softmax(self.actor(arrived), 1)
            least = torch.minimum(*(target(arrived) for target in self.targets))
            beyond = (log_pi.exp() * (least - alpha * log_pi)).sum(1)
            y = rows[:, 9] + (1 - rows[:, 10]) * self.o.gamma * beyond
        taken = [critic(states).gather(1, action).squeeze(1) for critic in self.critics]
        self._step(0, sum(torch.nn.functional.mse_loss(value, y) for value in taken))  # type: ignore[arg-type]
        log_pi = torch.log_softmax(self.actor(states), 1)
        with torch.no_grad():
            least = torch.minimum(*(critic(states) for critic in self.critics))
        self._step(1, (log_pi.exp() * (alpha * log_pi - least)).mean())
        short = (log_pi + self.o.target_entropy).detach()
        self._step(2, (log_pi.exp().detach() * (-self.log_alpha.exp() * short)).mean())
        with torch.no_grad():
            for target, parameter in zip(self.targets.parameters(), self.critics.parameters()):
                target.lerp_(parameter, self.o.tau)


def draws(values: FloatArray, source: int, resamples: int = 10_000) -> FloatArray:
    """Return the medians of resamples of `values` (seeds,)."""
    picked = np.random.default_rng(source).integers(len(values), size=(resamples, len(values)))
    medians: FloatArray = np.median(values[picked], axis=1)
    return medians


def report(all_runs: list[Runs]) -> None:
    """Print every implementation's measures, and the differences of the first to the others."""
    mine = all_runs[0]
    for source, runs in enumerate(all_runs):
        print(f"\n{runs.name}: {runs.seconds:.2f} s per seed ({runs.seconds / mine.seconds:.1f} times ours)")
        for measure, values in runs.measures().items():
            form = (lambda v: f"{v:,.0f}") if measure.startswith("steps") else (lambda v: f"{v:.4g}")
            low, high = np.percentile(draws(values, source), [5, 95])
            line = f"  {measure:14}{form(np.median(values)):>9} ({form(low)} to {form(high)})"
            if measure.startswith("steps"):
                never = int((values > INTERACTIONS * runs.scores.shape[1]).sum())
                line += f", never by {never} of {len(values)}" if never else ""
            if runs is not mine:
                difference = draws(mine.measures()[measure], 0) - draws(values, source)
                low, high = np.percentile(difference, [5, 95])
                line += f"   ours - theirs: {form(low)} to {form(high)}"
            print(line)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algorithms", nargs="+", choices=sorted(SETTINGS), default=sorted(SETTINGS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--epochs", type=int, default=100, help="of 1000 interactions each")
    parser.add_argument("--preset", help="the preset of the task that both learn with")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="another setting")
    parser.add_argument("--json", type=Path, help="also write every curve to this file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds, stored = range(arguments.seeds), {}
    for algorithm in arguments.algorithms:
        settings = [parse_setting(word) for word in [*SETTINGS[algorithm], *arguments.set]]
        preset = arguments.preset or (None if algorithm == "sac" else "tuned")  # which has nothing for it
        entry = resolve("cartpole", "mlp", algorithm, settings, preset)
        all_runs = [ours(entry, seeds, arguments.epochs)]
        peers: dict[str, Callable[[Any, int], Any]] = {
            "SB3 PPO": sb3_ppo(entry),
            "SBX PPO": sb3_ppo(entry, jax=True),
        }
        if algorithm == "ppo":
            all_runs.append(by_rejax(entry, seeds, arguments.epochs))
        if algorithm == "sac":
            peers = {"CleanRL SAC": functools.partial(CleanSAC, entry)}
        if algorithm == "ddqn":
            peers = {
                "SB3 DQN": sb3_dqn(entry, False),
                "SB3 DQN, our update": sb3_dqn(entry, True),
                "torch, one seed": functools.partial(PlainDDQN, entry),
            }
            all_runs.append(by_jax(entry, seeds, arguments.epochs))
        all_runs += [theirs(name, make, entry, seeds, arguments.epochs) for name, make in peers.items()]
        report(all_runs)
        stored[algorithm] = {
            r.name: {"scores": r.scores.tolist(), "seconds_per_seed": r.seconds} for r in all_runs
        }
        if arguments.json:
            arguments.json.write_text(json.dumps(stored), encoding="utf-8")


if __name__ == "__main__":
    main()
