# Two commands for a fresh machine: `make demo` and `make test`. PYTHON=python3.12 chooses another interpreter.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# The versions that everything here is tested with; CONSTRAINTS=/dev/null takes the newest.
CONSTRAINTS ?= constraints.txt
# Packages are compiled to bytecode when they are first imported: without it, each start of the
# program takes three times as long.
unexport PYTHONDONTWRITEBYTECODE
# Where a home cannot be written, the compiled kernels are kept with the packages: else every process
# would compile them anew.
ifneq ($(shell test -w "$(HOME)" && echo writable),writable)
export NUMBA_CACHE_DIR ?= $(abspath $(VENV))/kernels
endif
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check \
	--constraint $(CONSTRAINTS)

.PHONY: demo test tests test-all faults bench bench-quality docs install dist pins clean

# What the demo needs, and no more.
demo: $(VENV)/.installed
	$(BIN)/mrgs demo

# `make test` leaves out the slow tests; `make test-all` leaves out none, and checks the shapes of all
# arrays (docs/testing.md).
SELECT = -m "not slow"

# The types are checked while the kernels are compiled and the tests run; what is said of them comes at
# the end. Those of NumPy 2.2, the last for Python 3.10, are others: there they are not checked.
test: $(VENV)/.dev-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@($(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' || exit 0; $(BIN)/mypy) \
		> $(VENV)/types.log 2>&1 & types=$$!; \
	$(MAKE) --no-print-directory tests SELECT='$(SELECT)'; tests=$$?; \
	wait $$types; types=$$?; cat $(VENV)/types.log; exit $$((tests | types))

tests: $(VENV)/.dev-installed
	@$(MAKE) --no-print-directory $(VENV)/.kernels-compiled
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations 40 $(SELECT)

test-all: SELECT =
test-all: export CHECK_ARRAYS = 1
test-all: test

# Attacks for a night, with a table at the end; `make faults ARGS="--soak-hours 0 --texts 100000"` takes
# an hour.
faults: $(VENV)/.dev-installed
	$(BIN)/python -W ignore -m tests.faults $(ARGS)

# Some ten minutes on two cores that do nothing else; `make bench ARGS=--quick` takes two.
bench: $(VENV)/.dev-installed $(VENV)/.bench-installed
	$(BIN)/python -m benchmarks $(ARGS)

# Time until a training is good: an hour or so on three generated scenes.
bench-quality: $(VENV)/.dev-installed $(VENV)/.bench-installed $(VENV)/.synth-installed
	$(BIN)/python -m benchmarks.quality $(ARGS)

# The documentation site, into build/site; warnings are errors (with --quiet they would not be).
docs: $(VENV)/.docs-installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The sdist and the wheel, into dist.
dist: $(VENV)/.dev-installed
	$(BIN)/python -m build --no-isolation

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) hatchling hatch-fancy-pypi-readme
	$(PIP) --no-build-isolation --editable .
	@touch $@

# The packages of their own: a method, and `mrgs compare`.
$(VENV)/.plugins-installed: $(VENV)/.installed $(wildcard plugins/*/pyproject.toml)
	$(PIP) --no-build-isolation --editable ./plugins/compare --editable ./plugins/thermonerf
	@touch $@

$(VENV)/.dev-installed: $(VENV)/.plugins-installed

# uv takes a fifth of pip's time. It does not read pip's configuration: where that names an index, and
# where uv fails, pip does it.
$(VENV)/.%-installed: $(VENV)/.installed
	{ ! $(BIN)/python -m pip config list | grep -Eq '[.](index-url|no-index)=' \
		&& $(PIP) uv && $(BIN)/uv pip install --quiet --no-cache --python $(BIN)/python \
		--constraint $(CONSTRAINTS) --no-build-isolation --editable ".[$*]"; } \
		|| $(PIP) --no-build-isolation --editable ".[$*]"
	@touch $@

# Else each of the tests' processes would compile the same kernels, for a minute or more.
KERNELS := $(shell find src plugins -path '*kernels*' -name '*.py')
$(VENV)/.kernels-compiled: $(VENV)/.plugins-installed $(KERNELS)
	$(BIN)/python tools/compile_kernels.py $@

# Pins every package that `make` can install, the indirect ones too, for every supported Python.
# What is pinned stays; `make pins ARGS=--upgrade` takes the newest versions that pyproject.toml allows.
pins: $(VENV)/.installed
	$(PIP) uv
	$(BIN)/uv pip compile pyproject.toml --quiet --extra dev --extra docs --extra bench $(ARGS) \
		--universal --python-version 3.10 --no-header --no-annotate --no-emit-index-url \
		--output-file constraints.txt

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache
