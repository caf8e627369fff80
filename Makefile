# Two commands for a fresh machine: `make demo` and `make test`. PYTHON=python3.12 chooses another interpreter.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test faults bench install lint clean

demo: $(VENV)/.installed
	$(BIN)/mrgs demo

test: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist worksteal

# Attacks for hours, with a table at the end; `make faults ARGS="--soak-hours 0"` takes about one.
faults: $(VENV)/.installed
	$(BIN)/python -W ignore -m tests.faults $(ARGS)

# Some ten minutes on two cores that do nothing else; `make bench ARGS=--quick` takes two.
bench: $(VENV)/.bench-installed
	$(BIN)/python -m benchmarks $(ARGS)

$(VENV)/.bench-installed: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[bench]"
	@touch $@

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	@touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache
