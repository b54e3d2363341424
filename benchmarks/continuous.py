"""Continuous actions on Pendulum-v1, side by side with Stable-Baselines3's SAC, TD3 and PPO at equal settings.

    pip install 'qrlsuite[bench]'
    python benchmarks/continuous.py [--algorithms sac td3 ppo] [--seeds 5] [--epochs 10] [--json out.json]

Every agent has the same network (two hidden layers of 64 rectifiers, torch's own initialization), learning rate,
discount, batch, replay buffer, gradient steps per interaction and noise; it learns from one environment of the task
`pendulum`, and every 1000 interactions it plays the same 20 greedy episodes as its peers. Settings are the defaults and
presets of the task. PPO's are those of RL Baselines3 Zoo with minibatches of 50, which divide 1000 samples; what its
peer does otherwise is switched to what the suite does: no clipping of gradients, ReLU and torch's initialization, and
actions rescaled to -1 .. 1, as the suite's networks have them. SAC and TD3 of the peer do that themselves.

Printed are the measures of `benchmarks/learning.py`: medians over seeds and, in brackets, their 5th to 95th bootstrap
percentiles (whole runs resampled, 10,000 times), interactions until a mean return first reaches -500 and -200, the mean
of the whole curve, the last mean return, and seconds of processor time per seed spent on learning, without evaluation.
Differences are ours minus theirs. One thread; all seeds of the suite are trained together, those of its peer one after
another.
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

learning.THRESHOLDS = (-500, -200)
SETTINGS = {"sac": [], "td3": [], "ppo": ["batch=50"]}


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
        trainer.algorithm.train_epoch(learning.INTERACTIONS)
        seconds += time.process_time() - begun
        scores.append(validated(trainer, trainer.act, epoch + 1))
    return Runs(f"qrlsuite {entry.algorithm.name}", np.stack(scores, axis=1), seconds / len(seeds))


def theirs(name: str, make: Callable[[Any, int], Any], entry: Entry, seeds: range, epochs: int) -> Runs:
    """Train a peer's agents one by one; `make` builds one from its environment and a seed."""
    seconds, curves = 0.0, []
    for seed in seeds:
        referee = Trainer(entry, [seed])  # whose validation episodes are played
        environment = gymnasium.make("Pendulum-v1")
        if entry.algorithm.name == "ppo":
            environment = gymnasium.wrappers.RescaleAction(environment, np.float32(-1), np.float32(1))
        agent = make(environment, seed)
        factor = 2.0 if entry.algorithm.name == "ppo" else 1.0

        def act(observations: Any, agent: Any = agent, factor: float = factor) -> Any:
            actions, _ = agent.predict(observations, deterministic=True)
            return (factor * np.asarray(actions)).astype(np.float32)

        scores = []
        for epoch in range(epochs):
            begun = time.process_time()
            agent.learn(learning.INTERACTIONS, reset_num_timesteps=False)
            seconds += time.process_time() - begun
            scores.append(float(validated(referee, act, epoch + 1)[0]))
        curves.append(scores)
    return Runs(name, np.array(curves), seconds / len(seeds))


def peer(entry: Entry) -> Callable[[Any, int], Any]:
    """Return a maker of the peer's agents at an entry's settings."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.noise import NormalActionNoise

    o, network = entry.algorithm_options, entry.model_options
    layers = [network.width] * network.depth
    common = {"learning_rate": o.lr, "gamma": o.gamma, "batch_size": o.batch, "device": "cpu"}
    if entry.algorithm.name == "ppo":
        policy: dict[str, Any] = {
            "net_arch": {"pi": layers, "vf": layers},
            "activation_fn": torch.nn.ReLU,
            "ortho_init": False,
            "optimizer_kwargs": {"eps": 1e-8},
        }
        common |= {
            "n_steps": learning.INTERACTIONS,
            "n_epochs": o.repeats,
            "gae_lambda": o.gae_lambda,
            "clip_range": o.clip,
            "ent_coef": o.entropy_coefficient,
            "vf_coef": o.value_coefficient,
            "max_grad_norm": float("inf"),
        }
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
    cls = {"sac": sb3.SAC, "td3": sb3.TD3, "ppo": sb3.PPO}[entry.algorithm.name]
    return lambda environment, seed: cls("MlpPolicy", environment, policy_kwargs=policy, seed=seed, **common)


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
        entry = resolve("pendulum", "mlp", algorithm, settings)
        name = f"SB3 {algorithm.upper()}"
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
