"""Continuous actions and memory, side by side with Stable-Baselines3 and sb3-contrib at equal settings.

    pip install '.[bench]'
    python benchmarks/continuous.py [--algorithms sac td3 ppo hill lstm] [--seeds 5] [--epochs 10] [--json out.json]

SAC, TD3 and PPO learn Pendulum-v1. Every agent has the same network (two hidden layers of 64 rectifiers, torch's own
initialization), learning rate, discount, batch, replay buffer, gradient steps per interaction and noise; it learns from
one environment of the task `pendulum`, and every 1000 interactions it plays the same 20 greedy episodes as its peers.
Settings are the defaults and presets of the task. PPO's are those of RL Baselines3 Zoo with minibatches of 50, which
divide 1000 samples; what its peer does otherwise is switched to what the suite does: no clipping of gradients, ReLU and
torch's initialization, and actions rescaled to -1 .. 1, as the suite's networks have them. SAC and TD3 of the peer do
that themselves.

`hill` is TD3 on MountainCarContinuous-v0 (`mountaincar-continuous`) with four environments: one gradient step for four
interactions, and noise of the same spread and correlation from step to step. That of its peer begins anew in every
episode, ours in every epoch.

`lstm` is PPO with memory beside RecurrentPPO of sb3-contrib, on CartPole-v1 without velocities (`cartpole-hidden`), in
four environments: an LSTM of 64 numbers and a linear layer, for actor and critic each, and minibatches of 125 steps.
Those of its peer follow each other in one environment or two, and are cut where episodes end; ours are five sequences
of 25 steps from anywhere.

Printed are the measures of `benchmarks/learning.py`: medians over seeds and, in brackets, their 5th to 95th bootstrap
percentiles (whole runs resampled, 10,000 times), interactions until a mean return first reaches -500 and -200 (on the
hill 50 and 90, with memory a mean score of 0.2 and 0.5), the mean of the whole curve, the last mean return or score,
and seconds of processor time per seed spent on learning, without evaluation. Differences are ours minus theirs. One
thread; all seeds of the suite are trained together, those of its peer one after another.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import gymnasium
import learning
import numpy as np
import torch
from learning import FloatArray, Runs, report

from qrlsuite.experiment.entry import Entry, resolve
from qrlsuite.options import parse_setting
from qrlsuite.training.trainer import Trainer, play_episodes

MEMORY = [
    "width=64",
    "gamma=.98",
    "gae_lambda=.8",
    "clip=.2",
    "entropy_coefficient=0",
    "batch=125",
    "length=25",
]
SETTINGS = {"sac": [], "td3": [], "ppo": ["batch=50"], "hill": [], "lstm": MEMORY}
TASKS = {"hill": ("mountaincar-continuous", "mlp", "td3"), "lstm": ("cartpole-hidden", "lstm", "ppo")}
THRESHOLDS = {"hill": (50, 90), "lstm": (0.2, 0.5)}


def validated(trainer: Trainer, act: Callable[..., Any], epoch: int) -> FloatArray:
    """Return the mean return of each seed's validation episodes of an epoch (seeds,)."""
    trainer.validation.seed_lanes([streams.numpy("validation", epoch) for streams in trainer.streams])
    scores = play_episodes(trainer.validation, lambda: act).scores
    means: FloatArray = scores.reshape(trainer.S, -1).mean(1)
    return means


def ours(entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train a population."""
    trainer = Trainer(entry, seeds)
    trainer.start()
    seconds, scores = 0.0, []
    for epoch in range(epochs):
        begun = time.process_time()
        trainer.algorithm.train_epoch(learning.INTERACTIONS // trainer.E)
        seconds += time.process_time() - begun
        scores.append(validated(trainer, trainer.act, epoch + 1))
    return Runs(f"qrlsuite {entry.algorithm.name}", np.stack(scores, axis=1), seconds / len(seeds))


def theirs(name: str, make: Callable[[Any, int], Any], entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train a peer's agents one by one; `make` builds one from its environment and a seed."""
    seconds, curves = 0.0, []
    for seed in seeds:
        referee = Trainer(entry, [seed])  # whose validation episodes are played
        agent = make(environment(entry), seed)
        factor = 2.0 if entry.algorithm.name == "ppo" and not hidden(entry) else None
        kept: list[Any] = [None]

        def act(
            observations: Any,
            begins: Any,
            infos: Any,
            agent: Any = agent,
            factor: Any = factor,
            kept: Any = kept,
        ) -> Any:
            actions, kept[0] = agent.predict(observations, kept[0], begins, deterministic=True)
            return actions if factor is None else (factor * np.asarray(actions)).astype(np.float32)

        scores = []
        for epoch in range(epochs):
            begun = time.process_time()
            agent.learn(learning.INTERACTIONS, reset_num_timesteps=False)
            seconds += time.process_time() - begun
            kept[0] = None
            scores.append(float(validated(referee, act, epoch + 1)[0]))
        curves.append(scores)
    return Runs(name, np.array(curves), seconds / len(seeds))


def hidden(entry: Entry) -> bool:
    """Return whether an entry has to remember."""
    return entry.task.name == "cartpole-hidden"


def environment(entry: Entry) -> Any:
    """Return what a peer learns from."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    if entry.task.name == "mountaincar-continuous":
        made = entry.task.file.protocol.environments * [lambda: gymnasium.make("MountainCarContinuous-v0")]
        return DummyVecEnv(made)
    if not hidden(entry):
        made = gymnasium.make("Pendulum-v1")
        if entry.algorithm.name == "ppo":
            made = gymnasium.wrappers.RescaleAction(made, np.float32(-1), np.float32(1))
        return made

    def cartpole() -> Any:
        whole, shown = gymnasium.make("CartPole-v1"), [0, 2]
        space = whole.observation_space
        part = gymnasium.spaces.Box(space.low[shown], space.high[shown])
        return gymnasium.wrappers.TransformObservation(whole, lambda seen: seen[shown], part)

    return DummyVecEnv([cartpole] * entry.task.file.protocol.environments)


def peer(entry: Entry) -> Callable[[Any, int], Any]:
    """Return a maker of the peer's agents at an entry's settings."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    o, network = entry.algorithm_options, entry.model_options
    layers = [network.width] * getattr(network, "depth", 0)
    common = {"learning_rate": o.lr, "gamma": o.gamma, "batch_size": o.batch, "device": "cpu"}
    if entry.algorithm.name == "ppo":
        policy: dict[str, Any] = {
            "net_arch": {"pi": layers, "vf": layers},
            "activation_fn": torch.nn.ReLU,
            "ortho_init": False,
            "optimizer_kwargs": {"eps": 1e-8},
        }
        common |= {
            "n_steps": learning.INTERACTIONS // entry.task.file.protocol.environments,
            "n_epochs": o.repeats,
            "gae_lambda": o.gae_lambda,
            "clip_range": o.clip,
            "ent_coef": o.entropy_coefficient,
            "vf_coef": o.value_coefficient,
            "max_grad_norm": float("inf"),
        }
        if hidden(entry):
            from sb3_contrib import RecurrentPPO

            policy["lstm_hidden_size"] = network.width
            return lambda made, seed: RecurrentPPO(
                "MlpLstmPolicy", made, policy_kwargs=policy, seed=seed, **common
            )
    else:
        policy = {"net_arch": layers, "activation_fn": torch.nn.ReLU}
        common |= {
            "buffer_size": o.buffer,
            "learning_starts": o.warm_up,
            "tau": o.tau,
            "train_freq": 1,
            "gradient_steps": o.updates,
        }
    if entry.algorithm.name == "td3":
        common |= {
            "policy_delay": o.delay,
            "target_policy_noise": o.target_noise,
            "target_noise_clip": o.target_clip,
            "action_noise": NormalActionNoise(np.zeros(1), np.full(1, o.noise)),
        }
        if o.correlation:
            step = np.full(1, o.noise * np.sqrt(1 - o.correlation**2))
            common["action_noise"] = OrnsteinUhlenbeckActionNoise(
                np.zeros(1), step, theta=1 - o.correlation, dt=1.0
            )
    cls = {"sac": sb3.SAC, "td3": sb3.TD3, "ppo": sb3.PPO}[entry.algorithm.name]
    return lambda made, seed: cls("MlpPolicy", made, policy_kwargs=policy, seed=seed, **common)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algorithms", nargs="+", choices=sorted(SETTINGS), default=sorted(SETTINGS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=10, help="of 1000 interactions each")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="another setting")
    parser.add_argument("--json", type=Path, help="also write every curve to this file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds, stored = range(arguments.seeds), {}
    for algorithm in arguments.algorithms:
        settings = [parse_setting(word) for word in [*SETTINGS[algorithm], *arguments.set]]
        entry = resolve(*TASKS.get(algorithm, ("pendulum", "mlp", algorithm)), settings)
        learning.THRESHOLDS = THRESHOLDS.get(algorithm, (-500, -200))
        name = "RecurrentPPO" if algorithm == "lstm" else f"SB3 {entry.algorithm.name.upper()}"
        all_runs = [
            ours(entry, seeds, arguments.epochs),
            theirs(name, peer(entry), entry, seeds, arguments.epochs),
        ]
        report(all_runs)
        stored[algorithm] = {
            runs.name: {"scores": runs.scores.tolist(), "seconds_per_seed": runs.seconds} for runs in all_runs
        }
        if arguments.json:
            arguments.json.write_text(json.dumps(stored), encoding="utf-8")


if __name__ == "__main__":
    main()
