"""Double Q-learning on CartPole in JAX: the loop of `plugins/algorithms/ddqn.py`, `vmap` over seeds, an epoch compiled.

The peer of `learning.py`. Its environment is CartPole-v1 written for arrays; `check()` compares it with Gymnasium's.
Everything that repeats is inside one compiled function: actions, environments, replay buffer, update, Adam.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Tree = Any


class Settings(NamedTuple):
    """What an epoch is compiled for."""

    width: int
    depth: int
    lr: float
    gamma: float
    epsilon: float
    buffer: int
    batch: int
    target_steps: int
    environments: int
    rounds: int


def step(state: jax.Array, action: jax.Array) -> jax.Array:
    """Return the next state (4,) of a cart pushed to the left (0) or right (1): Gymnasium's explicit Euler steps."""
    x, v, angle, omega = state
    force = jnp.where(action == 1, 10.0, -10.0)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    pull = (force + 0.05 * omega**2 * sine) / 1.1
    spin = (9.8 * sine - cosine * pull) / (0.5 * (4.0 / 3.0 - 0.1 * cosine**2 / 1.1))
    push = pull - 0.05 * spin * cosine / 1.1
    return jnp.stack([x + 0.02 * v, v + 0.02 * push, angle + 0.02 * omega, omega + 0.02 * spin])


def fallen(state: jax.Array) -> jax.Array:
    """Return whether the pole has fallen or the cart left."""
    return (jnp.abs(state[0]) > 2.4) | (jnp.abs(state[2]) > 12 * 2 * np.pi / 360)


def initial(key: jax.Array, s: Settings) -> list[tuple[jax.Array, jax.Array]]:
    """Return the layers of a network, drawn as `torch.nn.Linear` draws them."""
    sizes = [4, *[s.width] * s.depth, 2]
    layers = []
    for i, o in itertools.pairwise(sizes):
        key, first, second = jax.random.split(key, 3)
        bound = 1.0 / np.sqrt(i)
        layers.append(
            (
                jax.random.uniform(first, (i, o), minval=-bound, maxval=bound),
                jax.random.uniform(second, (o,), minval=-bound, maxval=bound),
            )
        )
    return layers


def values(layers: Tree, x: jax.Array) -> jax.Array:
    """Return Q values (B, 2) of observations (B, 4)."""
    for w, b in layers[:-1]:
        x = jax.nn.relu(x @ w + b)
    return x @ layers[-1][0] + layers[-1][1]


def begin(key: jax.Array, s: Settings) -> dict[str, Any]:
    """Return an agent before its first round."""
    key, own, first = jax.random.split(key, 3)
    online = initial(own, s)
    zeros = jax.tree.map(jnp.zeros_like, online)
    return {
        "key": key,
        "online": online,
        "target": online,
        "mean": zeros,
        "square": zeros,
        "updates": jnp.zeros((), jnp.int32),
        "stored": jnp.zeros((), jnp.int32),
        "buffer": jnp.zeros((s.buffer, 11)),
        "states": jax.random.uniform(first, (s.environments, 4), minval=-0.05, maxval=0.05),
        "steps": jnp.zeros(s.environments, jnp.int32),
    }


def one_round(a: dict[str, Any], s: Settings) -> dict[str, Any]:
    """Step every environment once, store the transitions, and make one update."""
    key, coin, choice, fresh, draw = jax.random.split(a["key"], 5)
    greedy = values(a["online"], a["states"]).argmax(1)
    explored = jax.random.randint(choice, greedy.shape, 0, 2)
    actions = jnp.where(jax.random.uniform(coin, greedy.shape) < s.epsilon, explored, greedy)
    after = jax.vmap(step)(a["states"], actions)
    terminated = jax.vmap(fallen)(after)
    steps = a["steps"] + 1
    over = terminated | (steps == 500)
    rows = jnp.concatenate(
        [
            a["states"],
            after,
            actions[:, None].astype(jnp.float32),
            jnp.ones((s.environments, 1)),
            1.0 - terminated[:, None].astype(jnp.float32),
        ],
        1,
    )
    places = (a["stored"] + jnp.arange(s.environments)) % s.buffer
    buffer = a["buffer"].at[places].set(rows)
    stored = a["stored"] + s.environments
    new = jax.random.uniform(fresh, after.shape, minval=-0.05, maxval=0.05)
    picked = jax.random.randint(draw, (s.batch,), 0, jnp.minimum(stored, s.buffer))
    batch = buffer[picked]
    following, chosen = batch[:, 4:8], batch[:, 8].astype(jnp.int32)
    best = values(a["online"], following).argmax(1)
    later = jnp.take_along_axis(values(a["target"], following), best[:, None], 1)[:, 0]
    y = batch[:, 9] + s.gamma * batch[:, 10] * later

    def loss(online: Tree) -> jax.Array:
        q = jnp.take_along_axis(values(online, batch[:, :4]), chosen[:, None], 1)[:, 0]
        return ((q - y) ** 2).mean()

    gradient = jax.grad(loss)(a["online"])
    updates = a["updates"] + 1
    mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, a["mean"], gradient)
    square = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, a["square"], gradient)
    rate, root = s.lr / (1 - 0.9**updates), 1 / jnp.sqrt(1 - 0.999**updates)
    online = jax.tree.map(
        lambda p, m, v: p - rate * m / (root * jnp.sqrt(v) + 1e-8), a["online"], mean, square
    )
    copied = updates % s.target_steps == 0
    return {
        "key": key,
        "online": online,
        "target": jax.tree.map(lambda new, old: jnp.where(copied, new, old), online, a["target"]),
        "mean": mean,
        "square": square,
        "updates": updates,
        "stored": stored,
        "buffer": buffer,
        "states": jnp.where(over[:, None], new, after),
        "steps": jnp.where(over, 0, steps),
    }


def compiled(s: Settings) -> tuple[Any, Any, Any]:
    """Return functions: agents of keys (S,), an epoch of agents, and greedy actions (S, B) of observations."""

    def epoch(agent: dict[str, Any]) -> dict[str, Any]:
        return jax.lax.scan(lambda a, _: (one_round(a, s), None), agent, None, s.rounds)[0]

    many = jax.jit(jax.vmap(epoch), donate_argnums=0)
    act = jax.jit(jax.vmap(lambda agent, x: values(agent["online"], x).argmax(1)))
    return jax.jit(jax.vmap(lambda key: begin(key, s))), many, act


def check(steps: int = 2000) -> float:
    """Return the largest difference between both CartPoles in random steps from equal states."""
    import gymnasium

    env: Any = gymnasium.make("CartPole-v1").unwrapped
    env.reset(seed=0)
    numbers, worst, ours = np.random.default_rng(0), 0.0, jax.jit(step)
    for _ in range(steps):
        before = np.array(env.state, np.float32)
        action = int(numbers.integers(2))
        env.state = tuple(before.astype(np.float64))
        _, _, terminated, _, _ = env.step(action)
        after = np.asarray(ours(jnp.asarray(before), action))
        worst = max(worst, float(np.abs(after - np.array(env.state)).max()))
        assert bool(fallen(jnp.asarray(after))) == terminated
        if terminated:
            env.reset()
    return worst
