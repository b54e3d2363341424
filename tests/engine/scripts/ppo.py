"""A PPO in one file, with CleanRL's habits: vector environments, a schedule over all steps, TensorBoard."""

import argparse
import random
import time

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.utils.tensorboard import SummaryWriter


def parse_args():
    parser = argparse.ArgumentParser()
    parser.add_argument("--exp-name", default="ppo")
    parser.add_argument("--env-id", default="CartPole-v1")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--total-timesteps", type=int, default=500_000)
    parser.add_argument("--learning-rate", type=float, default=5e-3)
    parser.add_argument("--num-envs", type=int, default=4)
    parser.add_argument("--num-steps", type=int, default=64)
    return parser.parse_args()


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        inputs = int(np.prod(envs.single_observation_space.shape))
        self.critic = nn.Sequential(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, 1))
        self.actor = nn.Sequential(
            nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, envs.single_action_space.n)
        )

    def get_action_and_value(self, x, action=None):
        probs = torch.distributions.Categorical(logits=self.actor(x))
        action = probs.sample() if action is None else action
        return action, probs.log_prob(action), probs.entropy(), self.critic(x).squeeze(-1)


if __name__ == "__main__":
    args = parse_args()
    writer = SummaryWriter(f"runs/{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}")
    writer.add_text("hyperparameters", str(vars(args)))
    random.seed(args.seed)
    np.random.seed(args.seed)  # noqa: NPY002 - as such scripts do
    torch.manual_seed(args.seed)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(
        gym.vector.SyncVectorEnv([lambda: gym.make(args.env_id) for _ in range(args.num_envs)])
    )
    agent = Agent(envs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate)
    global_step, updates = 0, args.total_timesteps // (args.num_envs * args.num_steps)
    obs = torch.Tensor(envs.reset(seed=args.seed)[0])
    for update in range(1, updates + 1):
        optimizer.param_groups[0]["lr"] = args.learning_rate * (1 - (update - 1) / updates)
        steps = []
        for _ in range(args.num_steps):
            global_step += args.num_envs
            with torch.no_grad():
                action, logprob, _, value = agent.get_action_and_value(obs)
            next_obs, reward, terminated, truncated, infos = envs.step(action.numpy())
            done = torch.Tensor(terminated | truncated)
            steps.append((obs, action, logprob, value, torch.Tensor(reward), done))
            obs = torch.Tensor(next_obs)
            for lane in np.flatnonzero(infos.get("_episode", [])):
                writer.add_scalar("charts/episodic_return", infos["episode"]["r"][lane], global_step)
        with torch.no_grad():
            last, advantages = agent.critic(obs).squeeze(-1), []
            advantage = torch.zeros(args.num_envs)
            for *_, value, reward, done in reversed(steps):
                delta = reward + 0.99 * last * (1 - done) - value
                advantage = delta + 0.99 * 0.95 * (1 - done) * advantage
                advantages.insert(0, advantage)
                last = value
        b_obs, b_actions, b_logprobs, b_values, *_ = (torch.cat(part) for part in zip(*steps))
        b_advantages = torch.cat(advantages)
        for _ in range(4):
            for batch in torch.randperm(len(b_obs)).split(64):
                _, logprob, entropy, value = agent.get_action_and_value(b_obs[batch], b_actions[batch])
                ratio, gain = (logprob - b_logprobs[batch]).exp(), b_advantages[batch]
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                policy = -torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
                targets = b_advantages[batch] + b_values[batch]
                loss = policy + 0.5 * (value - targets).pow(2).mean() - 0.01 * entropy.mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        writer.add_scalar("losses/policy_loss", policy.item(), global_step)
    envs.close()
    writer.close()
