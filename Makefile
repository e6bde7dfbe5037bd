# make run    the main job: measured cable -> ROS 2 topics -> prediction -> score and report
#             (make run ARGS="--factor 2 --episodes 14"; ARGS=--help lists them)
# make reroute  cameras to arm: a rope led through a slot, as processes; bag, report, video
#             (make reroute ARGS="--fault tracker_killed"; ARGS=--help lists them)
# make plant-twin  the rope's twins: recorded in the cell through cameras and tracker, identified, trained
# make test   set-up, lint, tests            make bench  the benchmarks
# make cables every number of the measured cables and the twins that ship (half an hour)
# make lint   ruff and mypy                  make clean  remove what was built (out/ and data/ stay)

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := ros,vision,plant,hardware,dev

# The first of these that runs and is 3.11 or 3.12. Override: make PYTHON=/path/to/python
PYTHON ?= $(shell for p in python3.11 python3.12 python3 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' >/dev/null 2>&1 && echo $$p && break; done)

.PHONY: run reroute plant-twin test bench cables lint setup clean

setup: $(STAMP)

$(STAMP): setup.py setup.cfg pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11 or 3.12 found; install one or pass PYTHON=/path/to/python" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@touch $@

run: $(STAMP)
	$(BIN)/python -m pred_ros.replay $(ARGS)

reroute: $(STAMP)
	$(BIN)/python -m pred_ros.reroute $(ARGS)

test: lint
	$(BIN)/python -m pytest -q -rs

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy pred_core pred_ros

bench: $(STAMP)
	@set -e; for script in $(filter-out benchmarks/measured_cables.py benchmarks/network_2x2.py benchmarks/hidden_%.py benchmarks/reroute%.py benchmarks/rope_tasks.py,$(wildcard benchmarks/*.py)); do \
		echo "== $$script"; $(BIN)/python $$script; done

cables: $(STAMP)
	@set -e; for cable in dlo1 dlo2; do $(BIN)/python benchmarks/measured_cables.py $$cable --out out/cables; done

plant-twin: $(STAMP)
	$(BIN)/python benchmarks/reroute.py twin --work out/trials $(ARGS)

clean:
	rm -rf $(VENV) build install log *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
