# make run: learn a CartPole synthetic environment until it is solved.  make test: the test suite.
# make claims: checks the documents' numbers against the stored rows.
# make docs: the site, in docs/_build/html.  make dist: the packages, in dist/.
# All make .venv first if it is missing; python3.11 or newer with pip and venv, make and git are all
# they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: run test test-slow test-suites test-examples test-ray test-lowest test-latest lint typecheck \
    claims docs linkcheck dist clean

run: $(VENV)/.installed
	$(BIN)/python -m sejax.run env=cartpole stop_when_solved=true run_dir=runs/first

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow -n 2 --dist worksteal

# --- with packages that the suite leaves out, each in an environment of its own in build/ -----------

test-suites test-examples test-ray test-lowest test-latest:
	$(PYTHON) -m venv --clear build/$@
	build/$@/bin/python -m pip install --quiet $(PACKAGES) pytest pytest-xdist chex hypothesis
	build/$@/bin/python -m pytest $(OPTIONS) -n 2 --dist loadfile $(TESTS:%=tests/test_%.py)

# Environments of other JAX suites, through stoa.
test-suites: PACKAGES := --constraint constraints.txt --editable '.[stoa]' brax craftax jumanji navix pgx playground xminigrid
test-suites: TESTS := other_suites

# Stable-Baselines3, sbx, rejax, and the PyTorch code that benchmarks compare with. On Linux, PyPI's
# torch brings CUDA along; PIP_EXTRA_INDEX_URL may name an index that has it without.
test-examples: PACKAGES := --constraint constraints.txt --editable '.[examples,mujoco]'
test-examples: TESTS := examples gym_sb3 torch_reference

# A Ray cluster of two nodes on this machine, whose processes are killed and stopped: half an hour.
test-ray: PACKAGES := --constraint constraints.txt --editable '.[ray,search]'
test-ray: TESTS := ray
test-ray: OPTIONS := -m slow

# A part of the suite with the oldest versions that pyproject.toml allows, and with the newest.
test-lowest: PACKAGES := --constraint constraints-lowest.txt --editable '.[gym,hub,mujoco]'
test-latest: PACKAGES := --editable '.[gym,hub,mujoco]'
test-lowest test-latest: TESTS := networks ddqn synthetic nes proxy_files gym hub mujoco config registry run

# --- the code, its site, its packages ---------------------------------------------------------------

claims: $(VENV)/.installed-dev
	$(BIN)/python -m tools.claims

lint: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

typecheck: $(VENV)/.installed-dev
	$(BIN)/mypy

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W --keep-going -n -b html -c docs . docs/_build/html

linkcheck: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -b linkcheck -c docs -D nb_execution_mode=off . docs/_build/linkcheck

# The wheel is tested in an environment of its own.
dist: $(VENV)/.installed-dist
	rm -rf dist
	$(BIN)/python -m build --quiet
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python -m pytest -m dist tests/test_dist.py
	$(BIN)/python -m pytest tests/test_hub.py

# Without its package python3-venv Debian's python makes half of one, and fails.
$(BIN)/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or newer is needed: make PYTHON=python3.11"'
	$(PYTHON) -m venv $(VENV) || { rm -f $(BIN)/python*; exit 1; }

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-%: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$*]'
	touch $@

clean:
	rm -rf $(VENV) build dist docs/_build
