"""Which part of sejax may import which: arrows point down."""

import ast
import graphlib
from pathlib import Path

ROOT = Path(__file__).parents[1] / "sejax"
# Modules and folders of sejax, the highest first. Each may import those below it, and its own
# folder; not its neighbours. A module may lie higher than its folder. Names in strings
# (`sejax.options.registry`, `sejax.__getattr__`) are looked up when somebody asks for what they
# stand for: they do not count.
LAYERS = [
    {"__main__"},
    {"search", "check"},
    {"run", "evaluate", "distill"},
    {"runs"},
    {"bilevel"},
    {"scoring"},
    {"generation"},
    {"evaluation", "myopia"},
    {"gym"},
    {"proxies.io", "proxies.zoo", "proxies.exact"},
    {"proxies.header"},
    {"training", "objectives"},
    {"proxies"},
    {"agents"},
    {"envs", "es"},
    {"ops"},
    {"options"},
    {""},
]


def name_of(path):
    parts = ["sejax", *path.relative_to(ROOT).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(ROOT.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}


def part_of(module):
    """The module, or the folder, of `LAYERS` that a module is or lies in."""
    name = module.partition(".")[2]
    return name if any(name in layer for layer in LAYERS) else name.partition(".")[0]


def imported(node):
    """Modules that a tree imports anywhere, also within functions, but for type checking."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            yield from (name for other in child.orelse for name in imported(other))
        elif isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute"
            names = [f"{child.module}.{alias.name}" for alias in child.names]
            yield from (name if name in MODULES else child.module for name in names)
        else:
            yield from imported(child)


GRAPH = {name: {other for other in imported(tree) if other in MODULES}
         for name, tree in TREES.items()}  # fmt: skip


def test_every_part_of_sejax_has_its_place():
    placed = [part for layer in LAYERS for part in layer]
    assert len(placed) == len(set(placed))
    assert {part_of(name) for name in MODULES} == set(placed)


def test_arrows_point_down():
    height = {part: -i for i, layer in enumerate(LAYERS) for part in layer}
    wrong = [
        f"{name} imports {other}"
        for name, others in GRAPH.items()
        for other in sorted(others)
        if part_of(other) != part_of(name) and height[part_of(other)] >= height[part_of(name)]
    ]
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other():
    graphlib.TopologicalSorter(GRAPH).prepare()  # raises CycleError, which names the modules
