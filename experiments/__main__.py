"""`python -m experiments`: what there is to run, a line each."""

import ast
import pkgutil
from pathlib import Path

import experiments


def main() -> None:
    """Prints each experiment's name and what it shows."""
    print("python -m experiments.NAME [quick=true] [FIELD=VALUE ...] [--help]\n")
    for module in sorted(pkgutil.iter_modules(experiments.__path__), key=lambda m: m.name):
        source = Path(experiments.__path__[0], f"{module.name}.py").read_text()
        if "\nEXPERIMENT = " in source:
            about = ast.get_docstring(ast.parse(source)) or ""
            print(f"  {module.name:22} {about.partition(chr(10))[0]}")


if __name__ == "__main__":
    main()
