"""Numbers that were measured on one CPU (AMD EPYC, AVX2), for programs that are fast there.

They change the time that a program takes. What it computes they change by rounding at most, since
sums are made in another order.
"""

VECTOR = 8  # float32 numbers that one instruction works on; a remainder costs more than padding

# A learning step on a network of one hidden layer is small up to this product of hidden and batch
# size: what surrounds its matrix products takes longer than they do. Such agents train twice as
# fast in batches of SMALL_NUM_PARALLEL as alone: default DDQN takes 0.050, 0.037, 0.030, 0.027 and
# 0.025 CPU s for 2,000 steps on CartPole's SE in batches of 1, 2, 4, 8 and 16. A population is
# filled up to whole batches.
SMALL_PRODUCT = 64 * 64
SMALL_NUM_PARALLEL = 8

# Where hyperparameters vary, a batch is cut into about NUM_BLOCKS blocks of at least MIN_BLOCK
# columns: enough to waste little, large enough for efficient products.
NUM_BLOCKS, MIN_BLOCK = 4, 32

# Numbers of network sizes that varied agents choose from, for one hidden layer and for more. Units
# that are switched off cost time: in proportion to the size of one layer, to its square with more.
NUM_SIZES, NUM_SIZES_DEEP = 6, 12


def width_of(num_agents: int) -> int:
    """The width of a batch, a power of two: the widest with which so many agents fill two batches.

    Two batches keep two devices busy. A last batch is filled up with copies, so a width of 16 would
    cost eight agents the time of sixteen.

    Example:
      >>> [width_of(num_agents) for num_agents in (1, 4, 8, 20)]
      [1, 2, 4, 8]
    """
    return 1 << max(0, (num_agents // 2).bit_length() - 1)


def whole_vectors(size: int) -> int:
    """A size rounded up to whole vectors."""
    return -(-size // VECTOR) * VECTOR
