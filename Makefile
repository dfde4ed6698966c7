# Two commands do all the set-up: `make demo` and `make test`.
PYTHON ?= python3
ROS2_PYTHON ?= python3.11
BIN := .venv/bin
READY := .venv/.ready

# The tests start hundreds of programs: without this each compiles the platform anew where the environment forbids to keep it.
export PYTHONDONTWRITEBYTECODE :=

UNIT := $(BIN)/pytest -m "not slow"
# One more than there are cores: a third of the quick tests' time is waiting.
BY := -n $$(($$(nproc) + 1)) --dist loadfile
SLOW := $(BIN)/pytest --durations 30 -m "slow
TOGETHER := $(SLOW) and together and not kubernetes" $(BY) --no-loadscope-reorder
# Most of what looks at the clock is idle most of the time.
TIMED := $(SLOW) and not together and not kubernetes" -n 2 --dist loadfile --no-loadscope-reorder
# Most of their time is a wait for the node, that starts pods. Files are named, for each process reads all that is given.
CLUSTER := $(SLOW) and kubernetes" -n $$(($$(nproc) + 1)) --dist load --maxschedchunk 1 \
	$$(grep -rl --include='*.py' 'mark\.kubernetes' tests | sed 's,/conftest.py$$,,' | sort)

.PHONY: demo test slow-together slow-timed slow-kubernetes unit coverage images fuzz jepsen check terraform checkov iaas fmt docs site licences audit ros2 lock clean

demo: $(READY) ## run the main job: a walker asks for virtual-trail and is driven across an emulated network
	$(BIN)/skytether demo

test: $(READY) ## every test that this machine can run; what is missing is skipped with its reason
	@rm -f .pytest_cache/v/cache/lastfailed
	$(UNIT) $(BY) || $(BIN)/python .ci/again.py $$?
	@export SKYTETHER_TEST_IMAGES=skytether-test-$$$$/; trap '.ci/remove-images "$$SKYTETHER_TEST_IMAGES"' EXIT; trap 'exit 130' INT TERM; \
		failed=; echo "Slow tests that bear company ..."; $(TOGETHER) || failed="$$failed $$?"; \
		echo "Slow tests that look at the clock, two at a time ..."; $(TIMED) || failed="$$failed $$?"; \
		echo "A cluster, for the tests that need one ..."; $(CLUSTER) || failed="$$failed $$?"; \
		$(BIN)/python .ci/again.py $$failed

slow-together: $(READY)
	$(TOGETHER)

slow-timed: $(READY)
	$(TIMED)

slow-kubernetes: $(READY)
	$(CLUSTER)

unit: $(READY) ## the quick part, under a minute
	$(UNIT) $(BY)

coverage: $(READY) ## the quick tests, and what share of each package they run; takes two to three times as long
	@mkdir -p build/coverage
	$(UNIT) $(BY) --cov --cov-report json:build/coverage/files.json || echo "Tests failed: those that judge moments may, beside what counts."
	@$(BIN)/python .ci/coverage.py < build/coverage/files.json

images: $(READY) ## the container images, on the Docker engine of this machine; prints build time and size of each
	$(BIN)/python images/build.py --sbom build/images/sbom

fuzz: $(READY) ## every byte that can arrive, with coverage, 30 s for each target (SECONDS=300 for more)
	$(BIN)/python tests/fuzz/run.py --seconds $(or $(SECONDS),30)

jepsen: $(READY) ## three orchestrators under faults, for MINUTES=5 (SEED=n, FAULTS=a,b of tests/jepsen/nemesis.py, PAIRS=1: two at once)
	@SKYTETHER_REQUIRE=netns,nftables,postgres,faketime,docker MINUTES=$(MINUTES) SEED=$(SEED) FAULTS=$(FAULTS) PAIRS=$(PAIRS) \
		$(BIN)/pytest -q tests/jepsen/long.py

check: $(READY) ## style, types and layers: the same for people and CI
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

terraform: $(READY) checkov ## Terraform's modules and examples: their own tests, names by the providers' schemas, checkov
	$(BIN)/pytest -q tests/terraform

checkov: .checkov/bin/checkov
	.checkov/bin/checkov --directory terraform --framework terraform --compact --quiet --skip-download

.checkov/bin/checkov:
	@$(PYTHON) -m venv .checkov
	@.checkov/bin/pip install --quiet --disable-pip-version-check checkov==3.3.30

iaas: $(READY) ## a bare virtual machine that Terraform makes, that joins, drives a robot, and is destroyed; minutes by step
	$(BIN)/python tests/iaas/run.py

fmt: $(READY) ## format, and mend what can be mended
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(READY) ## the pages that are made from the code
	$(BIN)/skytether orchestrator config --markdown > docs/configuration.md
	$(BIN)/python .ci/rest_api.py > docs/rest-api.md
	$(BIN)/python .ci/chart.py
	$(BIN)/python .ci/terraform_docs.py
	for service in navigation follow-in-front; do $(BIN)/python .ci/parameters.py $$service > docs/$$service-parameters.md || exit; done

site: $(READY) ## the documentation as a site in build/site; a link that leads nowhere ends it, or a page that none leads to
	$(BIN)/python -m sphinx -q -W --keep-going -b html -c docs -d build/site-cache . build/site
	@echo "The site's first page: build/site/index.html"

licences: $(READY) ## the licences of all that requirements.lock names, as a page
	$(BIN)/python .ci/licences.py > docs/licences.md

audit: .audit/bin/pip-audit ## known faults of all that requirements.lock names, where advisories can be had
	@$(PYTHON) .ci/audit.py $< $(WHERE)

.audit/bin/pip-audit:
	@$(PYTHON) -m venv .audit
	@.audit/bin/pip install --quiet --disable-pip-version-check pip-audit==2.10.1

ros2: .venv-ros2/.ready ## ROS 2 itself, for tests and benches, in an environment of its own: .venv-ros2, 280 MB

.venv-ros2/.ready: requirements-ros2.lock
	@command -v $(ROS2_PYTHON) >/dev/null || { echo "ROS 2's wheels are for Python 3.11; name it with ROS2_PYTHON=..."; exit 1; }
	@echo "Setting up .venv-ros2 ..."
	@test -x .venv-ros2/bin/pip || $(ROS2_PYTHON) -m venv .venv-ros2
	@.venv-ros2/bin/pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r requirements-ros2.lock
	@.venv-ros2/bin/python -c 'import rclpy'
	@touch $@

lock: $(READY) ## resolve pyproject.toml and requirements-ros2.in anew into their lock files
	$(BIN)/pip install --quiet uv
	$(BIN)/uv pip compile --quiet --all-extras --generate-hashes --universal --no-emit-index-url --no-header \
		--output-file requirements.lock pyproject.toml
	$(BIN)/uv pip compile --quiet --generate-hashes --python-version 3.11 --python-platform linux --no-emit-index-url --no-header \
		--output-file requirements-ros2.lock requirements-ros2.in

$(READY): requirements.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "Python 3.11 or newer is missing: apt-get install python3 python3-venv"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$$($(PYTHON) --version) is too old: Skytether needs 3.11 or newer; give another with PYTHON=python3.x"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "Python's venv is missing: apt-get install python3-venv"; exit 1; }
	@echo "Setting up .venv (once; about 500 MB) ..."
	@test -x $(BIN)/pip || $(PYTHON) -m venv .venv
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r requirements.lock
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

clean: ## remove what the build and the tools made
	rm -rf .venv .venv-ros2 .audit .checkov .fuzz dist build demo-output replay-output .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
