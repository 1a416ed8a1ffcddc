# Two commands: `make preflight` runs the bench, `make test` proves it. Both make their own environment first.
#   make quick    ruff and the short tests, for every edit                make test ARGS="-k bus"   a part of the tests
#   make lint     ruff and mypy alone                                     make pytest ARGS=..       the same without lint
#   make newcomer every line of README, tutorial and how-to pages; ARGS=shown a part (shown, pages)
#   make docs     the pages as a searchable site in site/, which needs no network
#   make bench    the project's benchmarks     make clean                what was made here, but for runs/
PYTHON ?= python3
VENV   ?= .venv
ARGS   ?=
# one more than there are CPUs: tests of programs on a bus wait for half of their time
WORKERS ?= $(shell expr $$(nproc) + 1)
BIN    := $(VENV)/bin
EXTRAS := dev,docs,view,plots,fleet,learn,measure,fmu,shell
# uv, where it is there, installs in a third of the time; pip does where uv cannot, as with a mirror that pip alone knows
UV     := $(shell command -v uv 2>/dev/null)
install = { test -n "$(UV)" && "$(UV)" pip install -q --python $(BIN)/python -e '$(1)'; } || \
  $(BIN)/python -m pip --disable-pip-version-check install -qq -e '$(1)'
MADE   := $(VENV)/.made
# with it each program that a test starts would compile the whole rig again (1.5 s)
unexport PYTHONDONTWRITEBYTECODE

.PHONY: env env-test preflight quick lint pytest test newcomer bench clean help
.DELETE_ON_ERROR:

preflight: env
	@$(BIN)/rig run preflight

# mypy runs beside the tests, at the price of one more process
test: env-test
	@echo "== ruff, and mypy --strict beside the tests"
	@$(BIN)/ruff check .
	@$(BIN)/mypy >$(VENV)/.mypy.log 2>&1 & types=$$!; $(MAKE) --no-print-directory pytest; tests=$$?; \
	  wait $$types || { cat $(VENV)/.mypy.log; exit 1; }; tail -1 $(VENV)/.mypy.log; exit $$tests

quick: env-test
	@$(BIN)/ruff check .
	@$(MAKE) --no-print-directory pytest ARGS="--quick $(ARGS)"

pytest: env-test
	@echo "== pytest"
	@$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

lint: env-test
	@echo "== ruff, then mypy --strict"
	@$(BIN)/ruff check .
	@$(BIN)/mypy

newcomer: env-test
	@PYTHONPATH=tests/support:tests/newcomer $(BIN)/python tests/newcomer/play_newcomer.py $(ARGS)

docs: env-test
	@$(BIN)/python docs/site/build_site.py site

bench: env-test
	@$(BIN)/rig bench

clean:
	@test ! -e $(VENV) -o -e $(VENV)/pyvenv.cfg || { echo "make: $(VENV) is there and is no virtual environment"; exit 2; }
	rm -rf $(VENV) build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

help:
	@sed -n '1,/^[^#]/{s/^# \{0,1\}//p}' Makefile

# Each stamp is written last, so an interrupted step is simply done again.
env: $(VENV)/.run
env-test: $(VENV)/.test

$(MADE):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "make: Python 3.11 or newer is needed; make PYTHON=/path/to/python names another"; exit 2; }
	@echo "== making the virtual environment $(VENV)"
	@test ! -e $(VENV) -o -e $(VENV)/pyvenv.cfg || { echo "make: $(VENV) is there and is no virtual environment"; exit 2; }
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV) >/dev/null || $(PYTHON) -m virtualenv --quiet $(VENV) 2>/dev/null || \
	  { rm -rf $(VENV); echo "make: this Python cannot make a virtual environment; on Debian: apt-get install python3-venv"; exit 2; }
	@touch $@

$(VENV)/.run: pyproject.toml $(MADE)
	@echo "== installing what the bench needs into $(VENV) (once, about a minute)"
	@$(call install,.)
	@touch $@

$(VENV)/.test: pyproject.toml $(MADE)
	@echo "== installing what the tests and the viewer need into $(VENV) (once, about two minutes)"
	@$(call install,.[$(EXTRAS)])
	@touch $@ $(VENV)/.run
