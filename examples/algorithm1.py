"""Algorithm 1 in one file: a network learns to be a world that teaches CartPole.

    python algorithm1.py --seed=0    # a minute of one CPU core; seeds 0 to 4 end at 185 to 200

A synthetic environment (SE) is a network with weights psi. New agents are trained on it alone; an
evolution strategy (NES) moves psi to where they score well on CartPole. Nothing of sejax is
imported; there it is `sejax/bilevel.py`. States are `[4]`, actions one-hot, `[2]`.

Source: Ferreira et al., "Learning Synthetic Environments and Reward Networks for Reinforcement
Learning" (ICLR 2022), Algorithm 1, with the score transform "All Better 2" of its appendix.
"""

import argparse

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

POPULATION, NUM_AGENTS = 64, 16  # n_p; new agents on psi itself, for K_psi
NOISE_STD, NOISE_DECAY, STEP_SIZE = 0.06, 0.96, 2.0  # sigma, its factor a generation, alpha
TRAIN_STEPS, EPISODE_STEPS = 1000, 10  # of an agent on the SE
BATCH, HIDDEN, DISCOUNT, TARGET_RATE = 32, 32, 0.99, 0.01  # discount: gamma
ADAM = optax.adam(3e-3)


def init_network(key, num_inputs, num_outputs):
    """Random weights of a network."""
    key_hidden, key_out = jax.random.split(key)
    hidden = jax.random.normal(key_hidden, (HIDDEN, num_inputs)) / num_inputs**0.5
    out = jax.random.normal(key_out, (num_outputs, HIDDEN)) / HIDDEN**0.5
    return hidden, jnp.zeros(HIDDEN), out, jnp.zeros(num_outputs)


def network(weights, x):
    """The network's output for a vector x."""
    hidden, hidden_bias, out, out_bias = weights
    return out @ jax.nn.relu(hidden @ x + hidden_bias) + out_bias


def synthetic_env(psi, state, action):
    """A step of the SE: s', r = E_psi(s, a)."""
    *next_state, reward = network(psi, jnp.concatenate([state, action]))
    return jnp.array(next_state), reward


def real_env(state, action):
    """A step of CartPole: s', r = E_real(s, a), and whether the pole has fallen."""
    _, speed, angle, spin = state
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    push = (action @ jnp.array([-10.0, 10.0]) + 0.05 * spin**2 * sin) / 1.1
    spin_change = (9.8 * sin - cos * push) / (0.5 * (4 / 3 - 0.1 * cos**2 / 1.1))
    change = jnp.array([speed, push - 0.05 * spin_change * cos / 1.1, spin, spin_change])
    next_state = state + 0.02 * change  # in 0.02 s
    has_fallen = (abs(next_state[0]) > 2.4) | (abs(next_state[2]) > jnp.pi / 15)
    return next_state, 1.0, has_fallen


def greedy(theta, state):
    """The action of the highest Q."""
    return jax.nn.one_hot(network(theta, state).argmax(), 2)


def train_agent(key, psi):
    """TrainAgent: the weights theta of a new DDQN agent, trained on the SE alone.

    Episodes begin with noise. After each step it learns from a batch of all steps so far, with
    L = (Q_theta(s, a) - r - gamma Q_theta'(s', argmax_a' Q_theta(s', a')))^2, where theta' follows
    theta slowly. The last step of an episode has no Q_theta'.
    """
    key_theta, key_steps = jax.random.split(key)
    theta = init_network(key_theta, num_inputs=4, num_outputs=2)
    replay = jnp.zeros((TRAIN_STEPS, 12))  # s, a, r, gamma or 0, s'

    def loss(theta, target, batch):
        def error(transition):
            state, action, (reward, discount), next_state = jnp.split(transition, [4, 6, 8])
            goal = reward + discount * network(target, next_state) @ greedy(theta, next_state)
            return network(theta, state) @ action - jax.lax.stop_gradient(goal)

        return jnp.mean(jax.vmap(error)(batch) ** 2)

    def step(carry, inputs):
        theta, target, adam, replay, state = carry
        time, key = inputs
        key_start, key_explore, key_action, key_batch = jax.random.split(key, 4)
        state = jnp.where(time % EPISODE_STEPS == 0, jax.random.normal(key_start, (4,)), state)
        explores = jax.random.uniform(key_explore) < 1 - time / TRAIN_STEPS
        random_action = jax.nn.one_hot(jax.random.randint(key_action, (), 0, 2), 2)
        action = jnp.where(explores, random_action, greedy(theta, state))
        next_state, reward = synthetic_env(psi, state, action)
        discount = jnp.where((time + 1) % EPISODE_STEPS == 0, 0.0, DISCOUNT)
        replay = replay.at[time].set(jnp.hstack([state, action, reward, discount, next_state]))
        batch = replay[jax.random.randint(key_batch, (BATCH,), 0, time + 1)]
        updates, adam = ADAM.update(jax.grad(loss)(theta, target, batch), adam)
        theta = optax.apply_updates(theta, updates)
        target = optax.incremental_update(theta, target, TARGET_RATE)
        return (theta, target, adam, replay, next_state), None

    carry = theta, theta, ADAM.init(theta), replay, jnp.zeros(4)
    inputs = jnp.arange(TRAIN_STEPS), jax.random.split(key_steps, TRAIN_STEPS)
    return jax.lax.scan(step, carry, inputs)[0][0]


def evaluate_agent(key, theta):
    """EvaluateAgent: the mean return of ten episodes of up to 200 steps on CartPole."""

    def step(carry, _):
        state, is_up = carry
        state, reward, has_fallen = real_env(state, greedy(theta, state))
        return (state, is_up & ~has_fallen), reward * is_up

    starts = jax.random.uniform(key, (10, 4), minval=-0.05, maxval=0.05)
    rewards = jax.vmap(lambda start: jax.lax.scan(step, (start, True), length=200)[1])(starts)
    return rewards.sum(axis=1).mean()


def nes(key, num_generations):
    """Algorithm 1: psi and K_psi of each generation.

    Candidates are psi + eps_i with eps_i ~ N(0, sigma^2 I). With K_i for the score of a new agent
    on a candidate, and K_psi for the mean score of new agents on psi itself,

        F_i = max(0, K_i - K_psi) / sum_j max(0, K_j - K_psi),    psi <- psi + alpha sum_i F_i eps_i
    """
    key_psi, key_generations = jax.random.split(key)
    psi, unravel = ravel_pytree(init_network(key_psi, num_inputs=6, num_outputs=5))

    def score(key, psi):
        key_train, key_test = jax.random.split(key)
        return evaluate_agent(key_test, train_agent(key_train, unravel(psi)))

    def generation(psi, inputs):
        number, key = inputs
        key_noise, key_agents = jax.random.split(key)
        sigma = NOISE_STD * NOISE_DECAY**number
        eps = sigma * jax.random.normal(key_noise, (POPULATION, psi.size))
        psis = psi + jnp.concatenate([eps, jnp.zeros((NUM_AGENTS, psi.size))])
        scores = jax.vmap(score)(jax.random.split(key_agents, len(psis)), psis)
        own = scores[POPULATION:].mean()
        jax.debug.print("generation {}: new agents return {:.1f}", number, own, ordered=True)
        advantage = jnp.maximum(0.0, scores[:POPULATION] - own)
        weights = advantage / jnp.maximum(1e-6, advantage.sum())
        return psi + STEP_SIZE * weights @ eps, (psi, own)

    keys = jax.random.split(key_generations, num_generations + 1)
    return jax.lax.scan(generation, psi, (jnp.arange(len(keys)), keys))[1]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--generations", type=int, default=50)  # n_o
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    learn = jax.jit(nes, static_argnums=1)
    jax.block_until_ready(learn(jax.random.key(args.seed), args.generations))


if __name__ == "__main__":
    main()
