# The two commands of the README, and what they are made of. Needs Python >= 3.11 and make, nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# The tests start hundreds of processes; without it each of them would compile this package's Python files again.
unexport PYTHONDONTWRITEBYTECODE

# The folder with kitti/ and nuscenes/, for `make tune` and `make ablate`.
DATA ?= data
KITTI = --dataset kitti --root $(DATA)/kitti --detections pointrcnn
NUSCENES = --dataset nuscenes --root $(DATA)/nuscenes --detections centerpoint

FUZZ_TARGETS := fuzz-messages fuzz-checkpoints fuzz-protobuf fuzz-frames
.PHONY: help kernels dist wheels docs pictures release image demo-files compare demo test accuracy alone bounds plain ray bench baseline figures load kills soak fuzz $(FUZZ_TARGETS) containers install lint types tests check mutants lowest paths pythons repeat schemas wheel clean tune ablate
help:
	@echo "make demo    start the service, replay a generated scene through it, draw the tracks (out/demo/)"
	@echo "make install a virtual environment with everything, and compiled kernels"
	@echo "make test    lint, types, schemas, tests"
	@echo "make wheel   build the wheel with machine code, install it alone into an empty environment, and use it there"
	@echo "make wheels  build wheels with machine code for each Python of this machine, beside the wheel in DIST=out/dist"
	@echo "make check   lint, types, and the tests nearest to what changed since SINCE=main, in less than a minute"
	@echo "make accuracy  hold the figures of accuracy on KITTI and nuScenes, where their data are"
	@echo "make mutants  make N=25 small faults by SEED=1 in a copy, and print which ones the nearest tests miss"
	@echo "make alone   run the tests that measure memory, latency and outages, one after the other"
	@echo "make bounds  call the tracker with every kernel compiled with bounds checks, which takes a minute"
	@echo "make plain   test the tracker with its kernels as Python, which makes small faults in it visible"
	@echo "make ray     track on Ray clusters, with workers and a node killed, which takes a minute"
	@echo "make lowest  test the wheel with the oldest packages that it may be installed with"
	@echo "make pythons test the wheel with the newest Python that this machine has"
	@echo "make paths   go the first ten minutes of six users, from empty environments with the wheel, and print what they take"
	@echo "make repeat  run make test N=10 times in fresh clones, with LOAD=0 processes that compute beside it"
	@echo "make bench   time the tracker, its kernels, the codec and the service, beside the saved baseline"
	@echo "make figures measure the tracker's figures of docs/performance.md, beside other trackers, and draw its plots"
	@echo "make compare evaluate the tracks of two other trackers beside ours, on the sample"
	@echo "make load    measure what the service carries on this machine, as docs/performance.md has it"
	@echo "make kills   kill the service a hundred times while recorded frames stream through it, and compare (needs KITTI)"
	@echo "make soak    load the service for an hour, and see that nothing grows and every message is counted"
	@echo "make fuzz    search for bytes that the decoders neither read nor refuse, FUZZ_S=1800 seconds per decoder"
	@echo "make containers  build the image, run the compose file's stack in containers, and show that it works"
	@echo "make tune    tune profiles from DATA=... (out/tune-*/tuned.toml), beginning at those of the paper"
	@echo "make ablate  print the figures of docs/ablation.md and docs/ablation/*.csv from DATA=..."
	@echo "make pictures draw the pictures of the pages again, into docs/images, and the outputs of the notebooks"
	@echo "make docs    build the documentation site into out/site and check its links"
	@echo "make release test, build and check a release, and print what would publish it"
	@echo "make image   build the image for PLATFORMS=linux/amd64,linux/arm64, and push it to PUSH=REPOSITORY"
	@echo "make demo-files  record a generated scene for Foxglove and Rerun, into out/demo"
	@echo "make clean   remove the virtual environment and everything generated"

# The stamp is newer than what it was made from, so a second call installs nothing.
$(VENV)/.installed: pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --editable ".[dev]"
	touch $@

# Kernels are compiled here, once, otherwise each program that imports the package would compile them.
install: kernels

# What the demo needs, and no tools of developers; in the environment of developers it is all there.
DEMO ?= $(if $(wildcard $(VENV)/.installed),$(VENV),.venv-demo)
$(DEMO)/bin/optipmb:
	$(PYTHON) -m venv $(DEMO)
	$(DEMO)/bin/python -m pip install --quiet --constraint requirements.lock ".[demo]"

demo: $(DEMO)/bin/optipmb
	$(DEMO)/bin/optipmb demo --out out/demo

# OPTIONAL=--optional: said clearly, and no failure, where no container engine runs.
containers: $(VENV)/.installed
	$(BIN)/python docker/containers.py $(OPTIONAL)

# The demonstration is among the tests (tests/e2e/test_demo.py); CI also runs the command, which installs less.
test: $(VENV)/.installed
	$(MAKE) --jobs 4 types kernels lint schemas tests

# For figures, nothing else should run on the machine. SERVICE holds options of the service, SECONDS how long a run takes.
load: install
	sh benchmarks/load.sh $(BIN)

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Less urgent than the kernels, which the tests wait for where the package has changed.
types: $(VENV)/.installed
	nice $(BIN)/mypy

# Before processes that would each compile them.
kernels: $(VENV)/.installed
	$(BIN)/optipmb warm-up --all

# More than two processors: what starts processes and waits for them leaves half of the time free. The order of files
# is that of tests/conftest.py: those with few and long tests would otherwise come last, with nothing beside them.
# A process that ends is not replaced: the next one would run the same test again, and wait as long.
JOBS ?= 5
# What a test calls with types that the warm-up lacks is compiled in its own process, not by others for it.
# Rewritten assertions are written to disk by one process before all workers would do the same.
# What failed in a run that was cut is in out/junit, and named in the output.
JUNIT = --junitxml=out/junit/$@.xml
tests: kernels
	test -d tests/tracker/__pycache__ || $(BIN)/pytest --collect-only -qq >/dev/null
	OPTIPMB_COMPILE_PROCESSES=0 $(BIN)/pytest $(JUNIT) -n $(JOBS) --max-worker-restart 0 --dist loadfile --no-loadscope-reorder -m "not accuracy and not alone and not bounds and not ray"

# Whole recordings, outages and clusters take longer than the two minutes that other tests have.
LONG := --timeout 500
# The figures of accuracy that docs/tuning.md and docs/ablation.md give, on the KITTI and nuScenes data.
accuracy: kernels
	$(BIN)/pytest $(JUNIT) -n $(JOBS) --max-worker-restart 0 $(LONG) tests/clients -m accuracy

# What measures memory, latency and outages, one test after the other.
alone: kernels
	$(BIN)/pytest $(JUNIT) $(LONG) tests/e2e tests/service/stream/test_memory.py tests/service/cluster/test_leases.py -m alone

# Compiling all kernels a second time takes a minute; what is compiled is kept in .pytest_cache.
bounds: $(VENV)/.installed
	$(BIN)/pytest $(JUNIT) $(LONG) tests/tracker -m bounds

# The tracker with its kernels as Python, as `make mutants` has it: files whose scenes are short.
PLAIN := oracle calibration class_posterior consistency field_of_view geometry hypotheses lifecycle motion soundness unknown_heading update zones
plain: $(VENV)/.installed
	NUMBA_DISABLE_JIT=1 $(BIN)/pytest $(JUNIT) -n 2 $(PLAIN:%=tests/tracker/test_%.py) -m "not bounds"

# Clusters on this machine, with the machine for themselves.
ray: kernels
	$(BIN)/pytest $(JUNIT) $(LONG) tests/clients -m ray

# For a developer: style, types, and the tests nearest to what changed since SINCE (a commit; files not committed count).
SINCE ?= main
check: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python benchmarks/nearest.py $(SINCE)

# Small faults at random places, in a copy of the tree: which ones do the nearest tests miss?
SEED ?= 1
mutants: kernels
	$(BIN)/python benchmarks/mutants.py $(SEED) $(if $(filter command line,$(origin N)),$(N),25)

# Both wheels without machine code, once for all that install them.
dist: $(VENV)/.installed
	mkdir -p out
	rm -rf out/dist
	$(BIN)/python -m build --wheel --outdir out/dist . >out/build.log || { cat out/build.log; exit 1; }
	$(BIN)/python -m build --wheel --outdir out/dist node >>out/build.log || { cat out/build.log; exit 1; }
	$(BIN)/python -m twine check --strict out/dist/* >>out/build.log || { cat out/build.log; exit 1; }

# Wheels with machine code beside the wheel without it in DIST, for each Python of this machine.
DIST ?= out/dist
wheels:
	sh packaging/wheels.sh $(DIST)

# The wheel with the oldest packages that pyproject.toml allows; and with the newest Python on this machine.
lowest: dist
	$(BIN)/python tests/lowest.py >out/lowest.txt
	sh tests/elsewhere.sh $(PYTHON) out/dist out/lowest.txt

# What stands on the first pages, from pip install to tracks, with processor time and halts; PATHS=start, csv, python, node, web or kitti walks one of them alone.
PATHS ?=
paths: dist
	$(BIN)/python benchmarks/paths.py out/dist $(PATHS)

pythons: dist
	sh tests/pythons.sh out/dist

# As often as N says, each time in a fresh clone, with LOAD processes computing beside it: tests that pass now and then fail here.
N ?= 10
LOAD ?= 0
repeat:
	sh tests/repeat.sh $(N) $(LOAD)

schemas: $(VENV)/.installed
	$(BIN)/python -m optipmb_schemas.export --check --page docs/messages.md --asyncapi schemas/asyncapi.json schemas/json
	$(BIN)/python -m optipmb_schemas.protobuf.export --check schemas
	$(BIN)/python docs/reference.py --check docs/reference.md

wheel: dist
	sh tests/wheel.sh $(PYTHON) $(BIN) out/dist

# The baseline is compared with and not obeyed: machines differ, and no test fails by a time. Processor time is counted,
# so that what else the machine does disturbs little; the service, which waits, has its own line and the clock on the wall.
BASELINES := benchmarks/baselines
TIMED := benchmarks/test_kernels.py benchmarks/test_tracker.py benchmarks/test_codec.py
BENCH := $(BIN)/pytest $(TIMED) -W default --benchmark-storage=file://$(BASELINES) --benchmark-group-by=fullname \
	--benchmark-columns=min,median,iqr,rounds --benchmark-timer=time.thread_time --benchmark-max-time=0.3
# The site, with every link checked; nothing is published.
DOCS := out/docs-env
$(DOCS)/.installed: pyproject.toml
	$(PYTHON) -m venv $(DOCS)
	$(DOCS)/bin/python -m pip install --quiet --constraint requirements.lock ".[client,docs]"
	touch $@

docs: $(DOCS)/.installed
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict
	@echo "the site is in out/site"

# Not live.png, live-phone.png, and the figures of performance.
pictures: kernels
	$(BIN)/python docs/pictures.py docs/images
	$(BIN)/python docs/notebooks.py examples

# Everything that a release needs, up to publishing.
release: $(VENV)/.installed
	sh tests/release.sh $(BIN)

# For several kinds of processors; PUSH names a repository of a registry.
PLATFORMS ?= linux/amd64,linux/arm64
PUSH ?=
image: $(VENV)/.installed
	sh docker/image.sh $$($(BIN)/python -c 'import optipmb; print(optipmb.__version__)') $(PLATFORMS) $(PUSH)

demo-files: kernels
	$(BIN)/python docs/demo_files.py out/demo

bench: install
	$(BENCH) --benchmark-compare
	$(BIN)/pytest benchmarks/test_service.py -s

baseline: install
	rm -rf $(BASELINES)
	$(BENCH) --benchmark-save=baseline

PEERS := out/peers
$(PEERS)/.installed:
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet "stonesoup==1.9.*" "norfair==2.*" "trackers==2.*"
	touch $@

COMPARED := out/compare
compare: install $(PEERS)/.installed
	mkdir -p $(COMPARED)
	$(BIN)/optipmb track examples/crossing.csv --out $(COMPARED)/optipmb --full
	$(PEERS)/bin/python benchmarks/peer_tracks.py examples/crossing.csv $(COMPARED)
	$(BIN)/optipmb evaluate examples/crossing.csv --truth examples/crossing_truth.csv --tracks $(COMPARED)/optipmb \
		--tracks $(COMPARED)/norfair.csv --tracks $(COMPARED)/bytetrack.csv --plot $(COMPARED)/compared.png

figures: install $(PEERS)/.installed
	mkdir -p out
	$(BIN)/python benchmarks/figures.py --peers $(PEERS)/bin/python --json out/figures.json --docs

tune: install
	$(BIN)/optipmb tune $(NUSCENES) --profile nuscenes-paper --classes car pedestrian --metric both --out out/tune-nuscenes
	$(BIN)/optipmb tune $(KITTI) --profile kitti-paper --jobs 2 --out out/tune-kitti

ablate: install
	$(BIN)/optipmb ablate $(KITTI) --markdown
	$(BIN)/optipmb ablate $(NUSCENES) --profile nuscenes --markdown

# A hundred SIGKILLs in the middle of recorded sequences, which CI does three times; needs the KITTI data.
kills: install
	OPTIPMB_TEST_KILLS=100 $(BIN)/pytest -q tests/e2e/test_kill.py --timeout 0 -o faulthandler_timeout=0

# An hour of load, which CI does for seconds.
soak: install
	OPTIPMB_TEST_SOAK_S=3600 OPTIPMB_TEST_SOAK_STREAMS=10 $(BIN)/pytest -q tests/e2e/test_soak.py --timeout 0 -o faulthandler_timeout=0

# What is found is kept in tests/fuzz/found, where the tests take it up. `make -j2 fuzz` searches two decoders at once.
FUZZ_S ?= 1800
fuzz: $(FUZZ_TARGETS)
$(FUZZ_TARGETS): fuzz-%: install
	$(BIN)/python tests/fuzz/search.py $* $(FUZZ_S)

clean:
	rm -rf $(VENV) .venv-demo out build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
