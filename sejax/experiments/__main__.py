"""`python -m sejax.experiments`: what there is to run, a line each."""

import importlib
import pkgutil

from sejax import experiments


def main() -> None:
    """Prints each experiment's name and what it shows."""
    print("python -m sejax.experiments.NAME [--quick] [--help]\n")
    for name in sorted(module.name for module in pkgutil.iter_modules(experiments.__path__)):
        module = importlib.import_module(f"sejax.experiments.{name}")
        if hasattr(module, "NAME"):
            print(f"  {name:20} {(module.__doc__ or '').partition(chr(10))[0]}")


if __name__ == "__main__":
    main()
