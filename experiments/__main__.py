"""`python -m experiments`: the list of all experiments."""

import importlib
import pkgutil

import experiments


def main() -> None:
    """Prints each experiment's name and the first line of its docstring."""
    print("python -m experiments.NAME [quick=true] [FIELD=VALUE ...] [--help]\n")
    for module in pkgutil.iter_modules(experiments.__path__):
        if not module.ispkg and module.name != "__main__":
            about = importlib.import_module(f"experiments.{module.name}").__doc__ or ""
            print(f"  {module.name:22} {about.partition(chr(10))[0]}")


if __name__ == "__main__":
    main()
