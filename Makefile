# make run: learn a CartPole synthetic environment until it is solved.  make test: the test suite.
# make docs: the site, in docs/_build/html.  make linkcheck: its links to other sites.
# All make .venv first if it is missing; python3.11 or newer, pip, make and git are all they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: run test test-slow test-sb3 test-trackers test-examples lint typecheck docs linkcheck clean

run: $(VENV)/.installed
	$(BIN)/python -m sejax.run env=cartpole stop_when_solved=true

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow -n 2 --dist worksteal

# What needs Stable-Baselines3, and with it torch, which the suite leaves out.
test-sb3: $(VENV)/.installed-dev
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[sb3]'
	$(BIN)/python -m pytest tests/test_gym_sb3.py

# The newest of what trackers need, in an environment of its own: trackio and constraints.txt have no
# pillow in common.
test-trackers:
	$(PYTHON) -m venv $(VENV)-trackers
	$(VENV)-trackers/bin/python -m pip install --quiet --editable '.[tensorboard,trackio,wandb]' pytest hypothesis
	$(VENV)-trackers/bin/python -m pytest tests/test_trackers.py

# The examples with agents of other packages, in an environment of its own. On Linux, PyPI's torch brings
# CUDA along; PIP_EXTRA_INDEX_URL may name an index that has it without.
test-examples:
	$(PYTHON) -m venv $(VENV)-examples
	$(VENV)-examples/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[examples]' hypothesis pytest
	$(VENV)-examples/bin/python -m pytest tests/test_examples.py

lint: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

typecheck: $(VENV)/.installed-dev
	$(BIN)/mypy

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W --keep-going -n -b html -c docs . docs/_build/html

linkcheck: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -b linkcheck -c docs -D nb_execution_mode=off . docs/_build/linkcheck

$(BIN)/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or newer is needed: make PYTHON=python3.11"'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-trackers $(VENV)-examples docs/_build
