"""Numbers that make programs fast on a CPU, measured on one (AMD EPYC, AVX2).

They change how long a program takes, and its results by rounding, because sums are made in another
order. The numbers of sizes also change which initial weights a varied agent draws.
"""

VECTOR = 8  # float32 numbers that one instruction works on; a remainder costs more than padding

# A learning step on one hidden layer is small up to this product of hidden size and batch size: its
# matrix products take less time than the operations around them. Such agents train twice as fast in
# batches of SMALL_NUM_PARALLEL as alone. The default DDQN takes 0.050, 0.037, 0.030, 0.027 and
# 0.025 CPU s for 2,000 steps on CartPole's SE in batches of 1, 2, 4, 8 and 16. A population is
# filled up to whole batches.
SMALL_PRODUCT = 64 * 64
SMALL_NUM_PARALLEL = 8

# If hyperparameters vary, a batch is cut into about NUM_BLOCKS blocks of MIN_BLOCK columns or more:
# enough blocks to waste little, and blocks large enough for efficient products.
NUM_BLOCKS = 4
MIN_BLOCK = 32

# Numbers of network sizes that varied agents choose from, for one hidden layer and for more. Units
# that are switched off cost time: in proportion to the layer's size with one hidden layer, and to
# its square with more.
NUM_SIZES, NUM_SIZES_DEEP = 6, 12


def balanced_num_parallel(num_agents: int) -> int:
    """The width of a batch: the largest power of two with which the agents fill two batches, or 1.

    Two batches keep two devices busy. The last batch is filled up with copies: with a width of 16,
    eight agents would take the time of sixteen.

    Example:
      >>> [balanced_num_parallel(num_agents) for num_agents in (1, 4, 8, 20)]
      [1, 2, 4, 8]
    """
    return 1 << max(0, (num_agents // 2).bit_length() - 1)


def whole_vectors(size: int) -> int:
    """A size rounded up to whole vectors."""
    return -(-size // VECTOR) * VECTOR
