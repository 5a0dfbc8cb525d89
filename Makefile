# The two commands of the README, and what they are made of. Needs Python >= 3.11 and make, nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help demo test load stack install lint types tests schemas wheel clean
help:
	@echo "make demo    start the service, replay a generated scene through it, draw the tracks (out/demo/)"
	@echo "make test    everything that CI runs: lint, types, tests, schemas, wheel, demo"
	@echo "make load    measure what the service carries on this machine, as docs/performance.md has it"
	@echo "make stack   run the compose file's stack as processes and show that it works (needs Debian's prometheus)"
	@echo "make clean   remove the virtual environment and everything generated"

# The stamp is newer than what it was made from, so a second call installs nothing.
$(VENV)/.installed: pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --editable ".[dev]"
	touch $@

install: $(VENV)/.installed

demo: install
	$(BIN)/optipmb demo --out out/demo

stack: install
	$(BIN)/python docker/stack.py --work out/stack

test: lint types tests schemas wheel demo

# For figures, nothing else should run on the machine. SERVICE holds options of the service, SECONDS how long a run takes.
load: install
	sh benchmarks/load.sh $(BIN)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy

tests: install
	$(BIN)/pytest

schemas: install
	$(BIN)/python -m optipmb_schemas.export --check --page docs/messages.md schemas/json
	$(BIN)/python -m optipmb_service.reference --check docs/operation.md

wheel: install
	sh tests/wheel.sh $(PYTHON) $(BIN)

clean:
	rm -rf $(VENV) out build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
