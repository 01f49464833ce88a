# make run    set up everything, sinter the three packs of sweeps/quick.toml, end with a table and their curves
# make pack   the same with one pack on 2 ranks, with pictures
# make test   set up everything and run the tests       (make slow: the long ones; make lint; make bench; make bench-paper)

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RANKS ?= 2
CASE ?= sweeps/cases/pack.toml
OUT ?= runs/$(basename $(notdir $(CASE)))
SWEEP ?= sweeps/quick.toml
DATA ?= runs/data

# Installed as a strict editable package: a new or removed file asks for a new install, an edited one does not.
FILES := $(sort $(shell find solver service sweeps -name '*.py'))
LISTED := $(VENV)/.files-$(shell echo "$(FILES)" | cksum | cut -d' ' -f1)

.PHONY: run pack test slow lint bench bench-paper setup clean

run: setup
	$(BIN)/frit sweep plan $(SWEEP) --data $(DATA)
	$(BIN)/frit sweep run $(SWEEP) --data $(DATA)
	$(BIN)/frit compare "$$(sed -n 's/^name = "\(.*\)"/\1/p' $(SWEEP) | head -n 1)" --data $(DATA) --out $(DATA)/curves.png

pack: setup
	@if [ -e "$(OUT)/run.json" ]; then \
	  case "$$(sed -n 's/.*"state": "\([a-z]*\)".*/\1/p' "$(OUT)/run.json")" in \
	    done|succeeded) echo "$(OUT) is done already; make clean removes it" ;; \
	    *) $(BIN)/frit resume "$(OUT)" ;; \
	  esac; \
	else $(BIN)/frit run "$(CASE)" --ranks $(RANKS) --out "$(OUT)"; fi
	$(BIN)/frit plot "$(OUT)" --out "$(OUT)/history.png"
	$(BIN)/frit plot "$(OUT)" --panel 0,end --out "$(OUT)/before-and-after.png"

test: setup
	$(BIN)/python -m pytest -n 2

slow: setup
	$(BIN)/python -m pytest -m slow

lint: setup
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/mypy tests

bench: setup
	$(BIN)/python tests/benchmarks/bench.py

bench-paper: setup
	$(BIN)/python tests/benchmarks/bench_paper.py

setup: $(LISTED)

$(BIN)/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "frit needs Python 3.11 or newer"'
	$(PYTHON) -m venv $(VENV)

$(LISTED): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[test,lint]'
	rm -f $(VENV)/.files-*
	touch $@

clean:
	rm -rf runs
