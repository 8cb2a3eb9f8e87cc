# The verbs of the house. Each sets up what it needs; nothing has to be installed before but Python 3.11+ and make.

SHELL := /bin/sh
.DEFAULT_GOAL := help
PROJECTS := pyproject.toml $(wildcard services/*/pyproject.toml)
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

help: ## This list
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

.venv/ready-run: constraints.txt $(PROJECTS) deploy/environment.sh
	@deploy/environment.sh run

.venv/ready-dev: constraints-dev.txt $(PROJECTS) deploy/environment.sh
	@deploy/environment.sh dev

demo: .venv/ready-run ## A whole simulated cell; STROKES=60 HEADLESS=1 for scripts, DATA=folder, PORT=base port
	@exec .venv/bin/wearline demo $(if $(STROKES),--strokes $(STROKES)) $(if $(HEADLESS),--headless) \
	    $(if $(DATA),--data $(DATA)) $(if $(PORT),--base-port $(PORT)) $(if $(STROKE_PERIOD),--stroke-period $(STROKE_PERIOD))

test: .venv/ready-dev ## All tests; WEARLINE_NO_SKIP=1 turns every skip into a failure; T="-k name" passes options
	@.venv/bin/python -m pytest $(T)

lint: .venv/ready-dev ## ruff, mypy --strict and the dependency rule
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports

format: .venv/ready-dev ## Let ruff format the tree
	@.venv/bin/ruff check --fix-only -q . ; .venv/bin/ruff format .

bench: .venv/ready-run ## Speed and precision against known truth
	@.venv/bin/wearline bench

.PHONY: judge-series
judge-series: .venv/ready-dev ## Flakes, good parts and verdicts on hundreds of rendered parts (long, resumes); N="--good 200" limits
	@nice -n 10 .venv/bin/python -m tests.metrology.judge_series $(N)

.PHONY: wear-forecast
wear-forecast: .venv/ready-dev ## Forecasts on 1000 simulated dies beside a straight line and an EWMA rule
	@.venv/bin/python -m tests.metrology.wear_series $(N)

browser: .venv/ready-dev ## The screens in Chromium, the long forms too
	@.venv/bin/python -m pytest -m "slow or not slow" tests/browser $(T)

fuzz: .venv/ready-dev ## 10 000 mutated frames through the measuring chain (long)
	@.venv/bin/python -m pytest -m slow tests/metrology/test_mutations.py $(T)

kills: .venv/ready-dev ## 20 kill -9 and 7 hung services while strokes run (long)
	@.venv/bin/python -m pytest -m slow tests/faults $(T)

mutations: .venv/ready-dev ## Break the product on purpose and see a test go red; T=word picks some (long)
	@.venv/bin/python -m tests.mutations $(T)

e2e: .venv/ready-dev ## The cell of deploy/compose.yaml in containers, for real (needs Docker and `make images`)
	@.venv/bin/python -m pytest -m slow tests/system/test_containers.py $(T)

helm: .venv/ready-dev ## What helm makes of the chart (needs helm)
	@.venv/bin/python -m pytest -m "slow or not slow" tests/unit/deploy/test_helm.py $(T)

records-million: .venv/ready-dev ## A million records on SQLite and PostgreSQL: insert, list and trend (long)
	@.venv/bin/python -m pytest -s -m slow tests/unit/judge/test_records.py -k million $(T)

kill-writers: .venv/ready-dev ## kill -9 while records are written, 200 times each on SQLite and PostgreSQL (long)
	@.venv/bin/python -m pytest -m slow tests/unit/judge/test_records.py -k kills $(T)

plc-faults: .venv/ready-dev ## Every network fault at every step of a PLC cycle, and 3000 random histories (long)
	@.venv/bin/python -m pytest -m slow -s tests/faults/test_plc_faults.py $(T)
	@WEARLINE_FAULT_EXAMPLES=3000 .venv/bin/python -m pytest tests/unit/fieldbus/test_handshake_machine.py \
	    tests/unit/fieldbus/test_extended.py -k Faults --timeout 1800

proof: .venv/ready-dev ## Search the model of the PLC handshake exhaustively, small and large size (needs spin, gcc); T=--stories
	@.venv/bin/python -m tests.proof.run $(T)

handshake-mutations: .venv/ready-dev ## Leave out every guard of the handshake in turn and see who objects (long; needs spin, gcc)
	@.venv/bin/python -m tests.proof.mutations $(T)

handshake-walk: .venv/ready-dev ## 10^5 random triggers of the real handshake against the reference PLC
	@WEARLINE_WALK_TRIGGERS=100000 .venv/bin/python -m pytest tests/proof/test_walk.py $(T)

handshake-soak: .venv/ready-dev ## 10^6 of them
	@WEARLINE_WALK_TRIGGERS=1000000 .venv/bin/python -m pytest tests/proof/test_walk.py $(T)

plc-bench: .venv/ready-dev ## Jitter and CPU of the PLC poll, time from verdict to PLC
	@.venv/bin/python -m tests.faults.plc_bench

images: ## Container images of all services (needs Docker with BuildKit)
	@deploy/images.sh

constraints: .venv/ready-dev ## Pin all third-party packages anew
	@deploy/pin.sh

clean: ## Forget the environment and the demo's data
	rm -rf .venv run build

.PHONY: help demo test lint format bench fuzz browser kills records-million kill-writers mutations images constraints clean plc-faults plc-bench proof handshake-mutations handshake-walk handshake-soak
