"""sejax.ops.flat: parameters as one vector and back, and Adam against a plain loop and optax."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from support import random_like, raveled, shapes_of

from sejax.ops import flat
from sejax.ops.networks import MLP

NET = MLP(2, hidden_size=3, num_layers=1, activation="prelu", learn_prelu_slope=True)
TREE = random_like(shapes_of(NET.init, jax.random.key(0), np.zeros(4)))


def test_a_vector_of_parameters_is_turned_back_into_them():
    unflatten = flat.unflattener(NET.init, np.zeros(4))

    @jax.jit
    def there_and_back(tree):
        vector = flat.flatten(tree)
        return vector, unflatten(vector)

    vector, tree = there_and_back(TREE)
    assert vector.shape == (4 * 3 + 3 + 3 * 2 + 2 + 1,) and vector.dtype == jnp.float32
    np.testing.assert_array_equal(vector, raveled(TREE))
    jax.tree.map(np.testing.assert_array_equal, tree, TREE)
    assert jax.tree.structure(tree) == jax.tree.structure(TREE)


def test_what_is_unflattened_is_shaped_as_init_would_shape_it_for_the_example():
    def init(key, width, note="none"):
        return {
            "weights": jnp.ones((2, width.shape[0])),
            "bias": jnp.ones(2),
            "scale": jnp.ones(()),
        }

    tree = flat.unflattener(init, np.zeros(3))(np.arange(9.0, dtype=np.float32))
    np.testing.assert_array_equal(tree["bias"], [0, 1])  # leaves in the order of their names
    np.testing.assert_array_equal(tree["scale"], 2)
    np.testing.assert_array_equal(tree["weights"], [[3, 4, 5], [6, 7, 8]])


@jax.jit
def steps_of_adam(params, gradients, rate):
    """Parameters after each step."""
    after, opt_state = [], flat.ADAM.init(params)
    for gradient in gradients:
        params, opt_state = flat.adam_step(params, opt_state, gradient, rate)
        after.append(params)
    return after, opt_state.count


def test_adam_equals_a_plain_loop_with_a_learning_rate_that_the_program_is_given():
    rng = np.random.default_rng(0)
    start, gradients = np.float32(rng.normal(size=5)), np.float32(rng.normal(size=(4, 5)))
    for rate in (0.01, 0.5):
        got, count = steps_of_adam(start, list(gradients), np.float32(rate))
        params, mean, square = start.astype(np.float64), np.zeros(5), np.zeros(5)
        for number, gradient in enumerate(gradients, start=1):
            mean = 0.9 * mean + 0.1 * gradient
            square = 0.999 * square + 0.001 * gradient**2
            corrected = mean / (1 - 0.9**number), square / (1 - 0.999**number)
            params = params - rate * corrected[0] / (np.sqrt(corrected[1]) + 1e-8)
            # float32 rounds 1 - 0.999**n to within 1e-4 of it, and a step is about as long as rate.
            np.testing.assert_allclose(got[number - 1], params, rtol=1e-5, atol=1e-4 * rate)
        assert count == len(gradients)


def test_adam_on_the_vector_is_adam_on_the_tree():
    gradients = [random_like(TREE, seed) for seed in (1, 2)]
    optimizer = optax.adam(0.1)

    @jax.jit
    def on_the_tree(tree):
        opt_state = optimizer.init(tree)
        for gradient in gradients:
            updates, opt_state = optimizer.update(gradient, opt_state)
            tree = optax.apply_updates(tree, updates)
        return tree

    got, _ = steps_of_adam(raveled(TREE), [raveled(g) for g in gradients], np.float32(0.1))
    np.testing.assert_allclose(got[-1], raveled(on_the_tree(TREE)), rtol=1e-5, atol=1e-6)


def test_no_gradient_moves_nothing_not_even_by_rounding():
    start = np.float32([1.0, -2.0, 1e-30])
    after, _ = steps_of_adam(start, [np.zeros(3, np.float32)] * 2, np.float32(0.1))
    np.testing.assert_array_equal(after[-1], start)
