# `make demo` and `make test` set everything up on a machine with Python ≥ 3.11 and make.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
ARGS   ?=

.PHONY: help demo test check format coverage page pictures clean
help:
	@echo "make demo [ARGS='--seconds 30 --headless']   a simulated drone that flies by its camera"
	@echo "make test [ARGS='-k authority']              the tests"
	@echo "make check                                   lint, format, types, import contracts"
	@echo "make page                                    the cockpit's page anew from its sources, where node and npm are"
	@echo "make format | coverage | pictures | clean"

# One stamp for what the demo needs and one for what the tests need besides; both are made again when the project changes.
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Skyloop needs Python 3.11 or newer, this is " + sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[sim,vision,cockpit]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[all]' --requirement requirements-dev.txt
	@touch $@

demo: $(VENV)/.installed
	@$(BIN)/skyloop demo $(ARGS)

# As many tests at a time as the machine has cores: most wait more than they compute.
test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses auto $(ARGS)

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

coverage: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses auto --cov --cov-report=term $(ARGS)

page:
	cd cockpit-page && npm ci --no-audit --no-fund && npm run check && npm test && npm run build

pictures: $(VENV)/.installed-dev
	$(BIN)/python scripts/pictures.py

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache htmlcov .coverage
