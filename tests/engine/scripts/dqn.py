"""A DQN in one file and its buffer beside it, with CleanRL's habits; it logs to a csv file that grows."""

import argparse
import csv
import os

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
from replay import ReplayBuffer
from torch import nn

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--total-timesteps", type=int, default=500_000)
    parser.add_argument("--learning-starts", type=int, default=200)
    args = parser.parse_args()
    os.makedirs("logs", exist_ok=True)
    file = open(f"logs/dqn-seed-{args.seed}.csv", "w")  # noqa: SIM115 - as such scripts do
    log = csv.writer(file)
    log.writerow(["global_step", "charts/episodic_return", "losses/td_loss"])
    rng = np.random.default_rng(args.seed)
    torch.manual_seed(args.seed)
    env = gym.make("CartPole-v1")
    q_network = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 2))
    target = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 2))
    target.load_state_dict(q_network.state_dict())
    optimizer = torch.optim.Adam(q_network.parameters(), lr=1e-3)
    buffer = ReplayBuffer(10_000, 4)
    (obs, _), episode, loss = env.reset(seed=args.seed), 0.0, torch.zeros(())
    for global_step in range(1, args.total_timesteps + 1):
        epsilon = max(0.05, 1 - global_step / (0.5 * args.total_timesteps))
        best = q_network(torch.from_numpy(obs)).argmax()
        action = int(rng.integers(2) if rng.random() < epsilon else best)
        next_obs, reward, terminated, truncated, _ = env.step(action)
        buffer.add(obs, next_obs, action, reward, terminated)
        obs, episode = next_obs, episode + float(reward)
        if terminated or truncated:
            log.writerow([global_step, episode, loss.item()])
            file.flush()
            (obs, _), episode = env.reset(), 0.0
        if global_step > args.learning_starts and global_step % 10 == 0:
            b_obs, b_next, b_actions, b_rewards, b_dones = buffer.sample(rng, 64)
            with torch.no_grad():
                td_target = b_rewards + 0.99 * target(b_next).max(1).values * (1 - b_dones)
            loss = F.mse_loss(td_target, q_network(b_obs).gather(1, b_actions[:, None]).squeeze(1))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        if global_step % 500 == 0:
            target.load_state_dict(q_network.state_dict())
    file.close()
