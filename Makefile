# `make demo` and `make test` set everything up on a machine with Python ≥ 3.11 and make.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
ARGS   ?=
# LOCKED=1 installs the exact versions of requirements-dev.lock instead of the newest that fit.
LOCKED ?=
PIP    := $(BIN)/python -m pip install --disable-pip-version-check $(if $(LOCKED),--constraint requirements-dev.lock)

# Where Python is told to keep nothing that it compiled, each process of the tests compiles the tests and the package anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test test-all test-core test-room test-elsewhere explore check check-elsewhere chaos docs fuzz format stubs coverage package page pictures lock clean
help:
	@echo "make demo [ARGS='--seconds 30 --headless']   a simulated drone that flies by its camera"
	@echo "make test [ARGS='-k authority']              the tests of every day, some 10 minutes; with ARGS, those that they select of all"
	@echo "make test-all                                all tests"
	@echo "make test-core                               the core's tests, without all that plugs into it, in 1 minute"
	@echo "make test-room ROOM=client                   the tests of one room that start no processes"
	@echo "make test-elsewhere                          some of them as on Windows and on macOS, two minutes each"
	@echo "make explore [SECONDS=3600]                  new examples for the tests of properties, for a minute"
	@echo "make check                                   lint, format, types, import contracts, budgets, prose"
	@echo "make chaos [ARGS='--seconds 180']            drones flown while processes die, stall, starve and are flooded"
	@echo "make fuzz [ARGS='--seconds 60 recording']    decoders, file readers and servers against hostile input"
	@echo "make docs                                    the tables of the code, and the documentation as a site: build/site"
	@echo "make package                                 wheel and source package, checked, and the demo flown from the wheel"
	@echo "make page                                    the cockpit's page anew from its sources, where node and npm are"
	@echo "make format | stubs | coverage | pictures | lock | clean"

# `dev.py` sets up the environment, where there is no make as well; its stamps are made again when the project changes.
export VENV LOCKED
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) dev.py install

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.txt requirements-dev.lock
	@$(PYTHON) dev.py install dev

demo:
	@$(PYTHON) dev.py demo $(ARGS)

# The tests of every day; ARGS select from all tests.
test:
	@$(PYTHON) dev.py test $(ARGS)

test-all: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses auto $(ARGS)

# In an environment of its own, in build/core.
test-core:
	PYTHON=$(PYTHON) scripts/core_alone.sh --numprocesses auto $(ARGS)

test-room: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses auto -m "not process and not slow" tests/$(or $(ROOM),$(error name a folder of tests/: make test-room ROOM=client)) $(ARGS)

# On Linux, with processes that take it for another system (tests/support/elsewhere): what differs there, and a test of each
# kind that starts processes.
ELSEWHERE := tests/transport tests/client tests/test_child_process.py tests/test_files.py tests/host/test_own_process.py \
  $(addprefix tests/integration/processes/test_,pilots.py recovery.py host.py) tests/recording/test_processes.py \
  tests/cockpit/test_server.py tests/cli/test_demo.py tests/cli/test_fly.py
test-elsewhere: $(VENV)/.installed-dev
	for system in win32 darwin; do \
	  SKYLOOP_PRETEND=$$system PYTHONPATH=tests/support/elsewhere $(BIN)/python -m pytest --numprocesses 4 -m "not slow" \
	    $(ELSEWHERE) $(ARGS) || exit; \
	done

# New examples for the tests of properties, for a minute by default: make explore SECONDS=3600.
SECONDS ?= 60
explore: $(VENV)/.installed-dev
	SKYLOOP_EXPLORE=$(SECONDS) $(BIN)/python -m pytest --numprocesses 0 -m "not process" $(ARGS)

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(if $(LATER),,$(MAKE) check-elsewhere)
	$(BIN)/lint-imports
	$(BIN)/python scripts/house.py --check
	$(BIN)/python scripts/paths.py --check
	$(BIN)/python scripts/prose.py --check

# Types as the other systems see them; `make check LATER=1` leaves them out.
check-elsewhere: $(VENV)/.installed-dev
	for system in win32 darwin; do $(BIN)/mypy --platform $$system --cache-dir .mypy_cache/$$system src/skyloop || exit; done

# Three minutes by default; an hour by hand: make chaos ARGS="--seconds 3600".
chaos: $(VENV)/.installed-dev
	$(BIN)/python -m tests.promises.chaos $(ARGS)

# A minute for each target by default.
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'atheris>=3'
	$(BIN)/python -m tests.promises.fuzz $(ARGS)

format: $(VENV)/.installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# What type checkers and editors see of skyloop.aio, anew.
stubs: $(VENV)/.installed-dev
	$(BIN)/python scripts/aio_stub.py
	$(BIN)/ruff format src/skyloop/aio/__init__.pyi

coverage: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses auto --cov --cov-report=term $(ARGS)
	$(BIN)/coverage json --quiet -o .coverage.json
	$(BIN)/python scripts/coverage_floor.py .coverage.json

# Wheel and source package in dist/.
package:
	rm -rf dist
	$(PYTHON) scripts/package_check.py --keep-in dist $(ARGS)

# The newest versions that fit, for LOCKED=1; without the places they come from.
lock: $(VENV)/.installed-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	(sed '/^\#/!d' requirements-dev.lock; $(BIN)/uv pip compile --quiet --universal --upgrade --python-version 3.11 --extra all \
	  --no-annotate --no-header --no-emit-index-url --no-emit-find-links pyproject.toml requirements-dev.txt requirements-docs.txt) >.lock.new
	mv .lock.new requirements-dev.lock

$(VENV)/.installed-docs: $(VENV)/.installed-dev requirements-docs.txt
	$(PIP) --requirement requirements-docs.txt
	@touch $@

# The tables that are lists of the code anew, then the site. A warning is an error, such as a link that leads nowhere.
docs: $(VENV)/.installed-docs
	$(BIN)/python -m scripts.doc_tables
	$(BIN)/python -m sphinx --quiet --jobs auto --fail-on-warning --keep-going --doctree-dir build/site-cache docs build/site
	@echo "build/site/index.html"

page:
	cd cockpit-page && npm ci --no-audit --no-fund && npm run check && npm test && npm run build

pictures: $(VENV)/.installed-dev
	$(BIN)/python scripts/pictures.py

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache htmlcov .coverage .coverage.json
