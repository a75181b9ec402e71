"""Agents in NumPy that see of a Gymnasium environment what everybody's agents see of it.

Observation, reward, `terminated` and `truncated`: `info` is not read. An episode that has
terminated is worth nothing further, one that was merely cut is bootstrapped.
"""

import copy
import itertools

import gymnasium
import numpy as np


class Network:
    """A perceptron of two hidden ReLU layers, with Adam (Kingma and Ba, 2015)."""

    def __init__(self, rng, num_inputs, num_outputs, squash=False, hidden=64, learning_rate=1e-3):
        sizes = (num_inputs, hidden, hidden, num_outputs)
        self.squash, self.learning_rate, self.num_updates = squash, learning_rate, 0
        self.weights = []  # kernel [in, out] and bias [out] of each layer
        for num_in, num_out in itertools.pairwise(sizes):
            shapes = (num_in, num_out), num_out
            self.weights += [rng.uniform(-1, 1, shape) / num_in**0.5 for shape in shapes]
        self.weights = [w.astype(np.float32) for w in self.weights]
        self.moments = [(np.zeros_like(w), np.zeros_like(w)) for w in self.weights]

    def follow(self, other, rate=0.01):
        for mine, its in zip(self.weights, other.weights, strict=True):
            mine += rate * (its - mine)

    def __call__(self, x):
        """Outputs `[batch, out]`, in (-1, 1) if squashed, of inputs `[batch, in]`."""
        self.inputs = [x]  # of each layer
        for kernel, bias in zip(self.weights[:-2:2], self.weights[1:-2:2], strict=True):
            self.inputs.append(np.maximum(self.inputs[-1] @ kernel + bias, 0))
        out = self.inputs[-1] @ self.weights[-2] + self.weights[-1]
        self.outputs = np.tanh(out) if self.squash else out
        return self.outputs

    def backward(self, slopes):
        """Gradients by weights and by inputs, given those by the last call's outputs."""
        gradients = []
        if self.squash:
            slopes = slopes * (1 - self.outputs**2)
        for layer in reversed(range(len(self.inputs))):
            x = self.inputs[layer]
            gradients = [x.T @ slopes, slopes.sum(axis=0), *gradients]
            slopes = slopes @ self.weights[2 * layer].T
            slopes = slopes * (x > 0) if layer else slopes
        return gradients, slopes

    def descend(self, gradients):
        """A step of Adam."""
        self.num_updates += 1
        rate = self.learning_rate * (1 - 0.999**self.num_updates) ** 0.5
        rate /= 1 - 0.9**self.num_updates
        for w, g, (m, v) in zip(self.weights, gradients, self.moments, strict=True):
            m += 0.1 * (g - m)
            v += 0.001 * (g * g - v)
            w -= rate * m / (np.sqrt(v) + 1e-8)


def learn(agent, env, num_steps, seed, random_steps=500, batch_size=64):
    """Trains an agent for a number of steps and returns it; its first actions are drawn blindly."""
    rng = np.random.default_rng(seed)
    env.action_space.seed(seed)
    memory = None  # observation, action, reward, whether it goes on, next observation
    obs, _ = env.reset(seed=seed)
    for step in range(num_steps):
        action = env.action_space.sample() if step < random_steps else agent.explore(obs, rng)
        next_obs, reward, terminated, truncated, _ = env.step(action)
        row = (obs, action, reward, not terminated, next_obs)
        memory = memory or [np.empty((num_steps, *np.shape(x)), np.float32) for x in row]
        for column, x in zip(memory, row, strict=True):
            column[step] = x
        obs = env.reset()[0] if terminated or truncated else next_obs
        if step >= batch_size:
            places = rng.integers(step + 1, size=batch_size)
            agent.update(*(column[places] for column in memory), rng)
    return agent


class DQN:
    """Deep Q-learning with a slow target network, by which it acts, 5% of the time at random."""

    def __init__(self, env, seed, discount=0.99):
        self.num_actions, self.discount = int(env.action_space.n), discount
        rng = np.random.default_rng(seed)
        self.values = Network(rng, env.observation_space.shape[0], self.num_actions)
        self.target = copy.deepcopy(self.values)

    def act(self, obs):
        return int(self.target(obs[None]).argmax())

    def explore(self, obs, rng):
        return int(rng.integers(self.num_actions)) if rng.random() < 0.05 else self.act(obs)

    def update(self, obs, action, reward, goes_on, next_obs, rng):
        rows, action = np.arange(len(obs)), action.astype(int)
        wanted = reward + self.discount * goes_on * self.target(next_obs).max(axis=1)
        slopes = np.zeros((len(obs), self.num_actions), np.float32)
        slopes[rows, action] = (self.values(obs)[rows, action] - wanted) / len(obs)
        self.values.descend(self.values.backward(slopes)[0])
        self.target.follow(self.values)


class DDPG:
    """Deterministic policy gradient with two critics, of which the lower one is believed."""

    def __init__(self, env, seed, discount=0.99):
        self.low, self.high, self.discount = env.action_space.low, env.action_space.high, discount
        rng = np.random.default_rng(seed)
        num_obs, num_actions = env.observation_space.shape[0], len(self.low)
        self.policy = Network(rng, num_obs, num_actions, squash=True)
        self.critics = [Network(rng, num_obs + num_actions, 1) for _ in range(2)]
        self.slow_policy = copy.deepcopy(self.policy)
        self.slow_critics = copy.deepcopy(self.critics)

    def act(self, obs):
        return self.scaled(self.policy(obs[None])[0])

    def explore(self, obs, rng):
        noisy = self.policy(obs[None])[0] + rng.normal(0, 0.2, len(self.low))
        return self.scaled(np.clip(noisy, -1, 1))

    def scaled(self, unit):
        """An action in the space's bounds, given one in [-1, 1]."""
        return (self.low + (unit + 1) / 2 * (self.high - self.low)).astype(np.float32)

    def update(self, obs, action, reward, goes_on, next_obs, rng):
        unit = 2 * (action - self.low) / (self.high - self.low) - 1
        ahead = np.hstack([next_obs, self.slow_policy(next_obs)])
        later = np.minimum(*(critic(ahead)[:, 0] for critic in self.slow_critics))
        wanted = (reward + self.discount * goes_on * later)[:, None]
        seen = np.hstack([obs, unit])
        for critic, slow in zip(self.critics, self.slow_critics, strict=True):
            critic.descend(critic.backward((critic(seen) - wanted) / len(obs))[0])
            slow.follow(critic)
        self.critics[0](np.hstack([obs, self.policy(obs)]))
        by_inputs = self.critics[0].backward(np.full((len(obs), 1), -1 / len(obs), np.float32))[1]
        self.policy.descend(self.policy.backward(by_inputs[:, obs.shape[1] :])[0])
        self.slow_policy.follow(self.policy)


def agent_for(env, seed):
    """A fresh agent for the environment's actions."""
    is_discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
    return (DQN if is_discrete else DDPG)(env, seed)


def mean_return(agent, env, num_episodes, seed):
    """Mean return of greedy episodes."""
    total = 0.0
    for episode in range(num_episodes):
        obs, _ = env.reset(seed=seed + episode)
        ended = False
        while not ended:
            obs, reward, terminated, truncated, _ = env.step(agent.act(obs))
            total += float(reward)
            ended = terminated or truncated
    return total / num_episodes
