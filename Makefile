# make run: learn a CartPole synthetic environment until it is solved.  make test: the test suite.
# Both make .venv first if it is missing; python3.11 or newer, pip, make and git are all they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: run test test-slow test-lowest test-latest lint typecheck dist clean

run: $(VENV)/.installed
	$(BIN)/python -m sejax.run env=cartpole stop_when_solved=true

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow -n 2 --dist worksteal

# A part of the suite with the oldest versions that pyproject.toml allows, and with the newest.
VERSIONS := networks ddqn synthetic nes proxy_files gym hub mujoco compose plugins run
test-lowest: CONSTRAINTS := --constraint constraints-lowest.txt
test-lowest test-latest: test-%: $(BIN)/python
	$(BIN)/python -m venv --clear build/venv-$*
	build/venv-$*/bin/python -m pip install --quiet $(CONSTRAINTS) --editable '.[gym,hub,mujoco]' \
	    chex hypothesis imageio pytest pytest-xdist
	build/venv-$*/bin/python -m pytest -n 2 --dist loadfile $(VERSIONS:%=tests/test_%.py)

# The wheel and the sdist in dist/, tested in an environment of their own.
dist: $(VENV)/.installed-dist
	rm -rf dist
	$(BIN)/python -m build --quiet
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python -m pytest -m dist tests/test_dist.py
	$(BIN)/python -m pytest tests/test_hub.py

lint: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

typecheck: $(VENV)/.installed-dev
	$(BIN)/mypy

$(BIN)/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or newer is needed: make PYTHON=python3.11"'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

$(VENV)/.installed-dist: $(VENV)/.installed-dev
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dist]'
	touch $@

clean:
	rm -rf $(VENV) build dist
