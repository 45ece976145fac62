# make demo    the whole benchmark on the two embedded data sets
# make test    the tests; make test-slow the long ones
# make ui      Dagster, MLflow and the reports on 127.0.0.1
# make screenshots   the README's pictures, of STORE (default results)
# make lerobot-env   LeRobot in an environment of its own, for the tests that need it

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo setup test test-slow ui speed lint clean lerobot-env screenshots

demo: $(READY)
	$(BIN)/demobench run pusht_sim so101_sim

setup: $(READY)

# The constraints pin every version; pip's cache makes a second environment cheap.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit("demobench needs Python 3.11 or newer; set PYTHON=…" if sys.version_info < (3, 11) else 0)'
	@echo "installing into $(VENV): about 3 minutes the first time"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[pusht,so101,dev]'
	touch $@

# Two test processes whose matrix products each want both cores wait for each other for most of their time.
test test-slow: export OPENBLAS_NUM_THREADS = 1

test: $(READY)
	$(BIN)/python -m pytest -n 2 -m "not slow"

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow

ui: $(READY)
	$(BIN)/demobench ui

speed: $(READY)
	$(BIN)/python -m speed

STORE ?= results

screenshots: $(READY)
	$(BIN)/python -m docs.screenshots $(STORE)

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

# LeRobot's pins exclude ours, and it wants Python 3.12: 5.7 GB on disk, most of it PyTorch with CUDA.
LEROBOT := .lerobot
LEROBOT_PYTHON ?= python3.12

lerobot-env: $(LEROBOT)/.ready

$(LEROBOT)/.ready:
	@$(LEROBOT_PYTHON) -c 'import sys; sys.exit("LeRobot needs Python 3.12 or newer; set LEROBOT_PYTHON=…" if sys.version_info < (3, 12) else 0)'
	$(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check 'lerobot[training,diffusion,smolvla]==0.6.1'
	touch $@

clean:
	rm -rf results build dist *.egg-info
