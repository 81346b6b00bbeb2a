# Each target is one command; the first one run makes .venv and installs what was tested (deploy/constraints.txt).

PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/installed

.PHONY: help demo test check bench faults soak hosts wheel clean

help:
	@echo "make demo     scan the micro-contour standard on the virtual rig"
	@echo "make test     the whole test suite"
	@echo "make check    style, types, layers"
	@echo "make bench    the numbers, with this machine's name"
	@echo "make faults   break everything in turn while a simulated scan runs (10 minutes)"
	@echo "make soak     the whole stack at 172 Hz for MINUTES=30"
	@echo "make hosts    a rig and a far host on good and bad links, in network namespaces (2 minutes)"
	@echo "make wheel    build dist/endo3d-*.whl"

$(INSTALLED): pyproject.toml deploy/constraints.txt
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" || { \
	  echo "endo3d needs Python 3.11 or newer; try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint deploy/constraints.txt --editable '.[dev]'
	@touch $@

demo: $(INSTALLED)
	$(BIN)/endo3d demo $(ARGS)

test: $(INSTALLED)
	$(BIN)/python -m pytest $(ARGS)

build/typings:
	@mkdir -p $@/endo3d
	@ln -sfn ../../../schemas $@/endo3d/schemas
	@ln -sfn ../../../services $@/endo3d/services

check: $(INSTALLED) build/typings
	$(BIN)/ruff check .
	$(BIN)/mypy -p endo3d.schemas -p endo3d.services -p endo3d_core
	$(BIN)/lint-imports

bench: $(INSTALLED)
	$(BIN)/python -m bench.run $(ARGS)

faults: $(INSTALLED)
	$(BIN)/python -m bench.reliability.faults $(ARGS)

soak: $(INSTALLED)
	$(BIN)/python -m bench.reliability.soak --minutes $(or $(MINUTES),30) $(ARGS)

hosts: $(INSTALLED)
	$(BIN)/python -m bench.hosts.run $(ARGS)

wheel: $(INSTALLED)
	@rm -rf build/lib  # a module that is gone would still get into the wheel
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

clean:
	rm -rf .venv build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache
