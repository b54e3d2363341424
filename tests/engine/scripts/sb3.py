"""Stable-Baselines3 as its users call it: a monitor, and evaluations by its callback."""

import sys

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

seed, steps = int(sys.argv[1]), int(sys.argv[2])
env = Monitor(gym.make("CartPole-v1"), f"sb3/{seed}/monitor.csv")
evaluate = EvalCallback(
    Monitor(gym.make("CartPole-v1")), log_path=f"sb3/{seed}", eval_freq=500, n_eval_episodes=3, verbose=0
)
model = PPO(
    "MlpPolicy", env, n_steps=250, batch_size=125, n_epochs=2, seed=seed, policy_kwargs={"net_arch": [8]}
)
model.learn(steps, callback=evaluate)
