# Daily commands. `make` builds .venv at the repository's root; everything else uses it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# What builds wheel, bundle and package: .venv where it is, else a small one, which takes a minute.
SMALL := .venv-build
BUILDER := $(if $(wildcard $(STAMP)),$(VENV),$(SMALL))

.DEFAULT_GOAL := venv
# One apt at a time: a lock on this folder.
APT := flock scripts
.PHONY: packages checks venv demo demo-sites demo-kill demo-start test test-bare tests test-long test-packages test-packages-short short-package short-chroot style format types imports reference docs fuzz soak soak-services soak-web bench experiment wheel deb bundle release ros ros2 chromium clients clean

$(STAMP): pyproject.toml constraints.txt scripts/bootstrap
	scripts/bootstrap $(PYTHON) $(VENV)
	touch $(STAMP)

$(SMALL)/.installed: pyproject.toml constraints.txt scripts/bootstrap
	scripts/bootstrap $(PYTHON) $(SMALL) small
	touch $@

venv: $(STAMP)  ## build .venv with everything that the commands below need

demo: $(STAMP)  ## the paper's set-up (Fig. 7) on this machine: make demo [SECONDS=30] [JOYSTICK=/dev/input/js0]
	@$(BIN)/python examples/turtlebot/demo.py $(if $(SECONDS),--seconds $(SECONDS)) $(if $(JOYSTICK),--joystick $(JOYSTICK))

demo-sites: $(STAMP)  ## the same modules at two sites, joined by gateways over a router: make demo-sites [SECONDS=30]
	@$(BIN)/python examples/turtlebot/demo.py --sites $(if $(SECONDS),--seconds $(SECONDS)) $(if $(JOYSTICK),--joystick $(JOYSTICK))

demo-kill demo-start: $(STAMP)  ## kill -9 a module of the running demo, start it again: make demo-kill MODULE=base
	@$(BIN)/python examples/turtlebot/demo.py $(@:demo-%=%) $(or $(MODULE),$(error name one: make $@ MODULE=base))

# Debian's packages and .venv are installed at one time, unless .venv itself needs packages of Debian.
test:  ## everything, with Debian's ROS 1, Chromium, npm and promtool where they can be installed
	$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || $(MAKE) venv
	$(MAKE) --jobs=2 --output-sync=target packages checks
	$(MAKE) tests

packages:
	$(APT) scripts/install-ros
	$(APT) scripts/install-chromium
	$(APT) scripts/install-clients
	$(APT) scripts/install-ros2

checks: style types imports

test-bare:  ## make test on a bare Debian in a chroot, which has almost nothing; some of it: make test-bare ARGS="make demo SECONDS=5"
	scripts/test-in-chroot $(ARGS)

chromium:  ## install Chromium for the tests of the monitor's pages (only where apt and root are there; else says so)
	$(APT) scripts/install-chromium

clients:  ## install npm and promtool for the tests of rmpa web against other people's clients (only where apt and root are there; else says so)
	$(APT) scripts/install-clients

ros:  ## install Debian's ROS 1 for the interop tests (only where apt and root are there; else says so)
	$(APT) scripts/install-ros

ros2:  ## ROS 2 (rclpy of Jazzy and Kilted) by pip for the interop tests, in a folder that is kept (else says so)
	$(APT) scripts/install-ros2

tests: $(STAMP)  ## all tests, several files at a time; some of them: make tests ARGS="tests/core -k names"
	$(if $(ARGS),$(BIN)/python -m pytest $(ARGS),scripts/run-tests $(BIN)/python)

test-long: $(STAMP)  ## more seeds of the simulated networks and fuzz targets than `make tests` has, and tests marked `long`
	RMPA_SIMULATION_SEEDS=16 FUZZ_MUTATIONS=20000 $(BIN)/python -m pytest -n auto --timeout 3600 tests/simulation tests/bridge/io tests/fuzz
	$(APT) scripts/install-ros --images
	$(BIN)/python -m pytest -m long --timeout 3600

test-packages: $(STAMP) ros  ## install by each way on machines of Debian 11, 12 and 13 (chroots), arm64 too, and let their nodes speak, and boot it with systemd; in half an hour
	version=$$($(BIN)/python scripts/version); for arch in x86_64 aarch64; do \
		[ -e dist/rmpa-$$version-linux-$$arch.tar.xz ] || $(MAKE) bundle ARCH=$$arch || exit; done
	version=$$($(BIN)/python scripts/version --deb); for arch in amd64 arm64; do \
		[ -e dist/rmpa_$${version}_$$arch.deb ] || $(BIN)/python packaging/debian/build --arch $$arch dist || exit; done
	$(MAKE) wheel
	$(APT) scripts/install-podman
	command -v lintian >/dev/null || DEBIAN_FRONTEND=noninteractive $(APT) apt-get install -y -q --no-install-recommends lintian
	RMPA_BUNDLE=dist/rmpa-$$($(BIN)/python scripts/version)-linux-x86_64 $(BIN)/python -m pytest -m "not long" tests/packages --ignore tests/packages/test_short.py

test-packages-short: $(STAMP) ros  ## the same in three minutes: a package with the system's Python, on one machine of this one's release; CI runs it
	rm -rf dist/short
	$(MAKE) --jobs=2 --output-sync=target short-package short-chroot
	$(BIN)/python -m pytest -m packages tests/packages/test_short.py

short-package:  # where none can be built, the test says why it is skipped
	-bundle=$$($(BIN)/python packaging/bundle/build --folder-only --python /usr dist/short | tail -n 1) && \
		DPKG_DEB_COMPRESSOR_LEVEL=0 $(BIN)/python packaging/debian/build --bundle $$bundle dist/short

short-chroot:  # likewise
	-. /etc/os-release && packaging/test/chroot $$VERSION_CODENAME $$(dpkg --print-architecture) rospy

style: $(STAMP)  ## ruff, and for the pages prettier and eslint where npm is: lint and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	scripts/style-pages

format: $(STAMP)  ## rewrite the files as `make style` wants them
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	scripts/style-pages --write

types: $(STAMP)  ## mypy, strict
	$(BIN)/mypy

imports: $(STAMP)  ## the rooms import one way only; pure rooms stay pure
	$(BIN)/lint-imports

reference: $(STAMP)  ## write docs/reference/commands.md, settings.md and limits.md, and docs/*.schema.json, from the code
	$(BIN)/python scripts/write-reference

docs: $(STAMP)  ## build the site of docs/ into site/, which is read from disk or from any web server
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "site/index.html, for a browser"

fuzz: $(STAMP)  ## every fuzz target for longer: make fuzz [SECONDS=60]
	$(BIN)/python -m tests.fuzz --seconds $(or $(SECONDS),60)

soak: $(STAMP) ros  ## disturb three modules for long and see that nothing leaks: make soak [SECONDS=600] [SEED=N]
	$(BIN)/python -m tests.soak --seconds $(or $(SECONDS),600) $(if $(SEED),--seed $(SEED))

soak-services: $(STAMP)  ## callers of a peer's services come and go at random; each must get an answer or an end: make soak-services [SECONDS=60] [SEED=N]
	$(BIN)/python -m tests.agent.service_storm --seconds $(or $(SECONDS),60) $(if $(SEED),--seed $(SEED))

soak-web: $(STAMP) chromium  ## modules, topics, clients and pages of rmpa web come and go for an hour; nothing may leak: make soak-web [SECONDS=3600] [SEED=N]
	$(BIN)/python -m tests.soak.web --seconds $(or $(SECONDS),3600) $(if $(SEED),--seed $(SEED))

bench: $(STAMP) ros  ## the measurements, as ratios in one run; results in lab/results
	-$(BIN)/pip install -q -c constraints.txt -e '.[web-peers,zenoh-peers]'  # a peer that cannot be installed is left out
	$(BIN)/python -m lab bench $(ARGS)

experiment: $(STAMP) ros  ## classic ROS beside RMPA, with a report: make experiment [ARGS="--short"]; docs/compare/experiments.md
	$(BIN)/python -m lab experiment run $(ARGS)

wheel: $(BUILDER)/.installed  ## build sdist and wheel into dist/ and check them
	scripts/build-wheel $(BUILDER)/bin/python

bundle: $(BUILDER)/.installed  ## build RMPA with a Python of its own into dist/: make bundle [ARCH=aarch64] [PREFIX=an interpreter that is there] [FRESH=1]
	$(BUILDER)/bin/python packaging/bundle/build $(if $(ARCH),--arch $(ARCH)) $(if $(PREFIX),--python $(PREFIX)) dist

# Debian's names of the machines that the bundle calls by the kernel's.
deb: $(BUILDER)/.installed  ## build the Debian package around the bundle into dist/: make deb [ARCH=arm64] [PREFIX=as for bundle]
	$(BUILDER)/bin/python packaging/bundle/build --folder-only $(if $(ARCH),--arch $(patsubst amd64,x86_64,$(patsubst arm64,aarch64,$(ARCH)))) $(if $(PREFIX),--python $(PREFIX)) dist
	$(BUILDER)/bin/python packaging/debian/build $(if $(ARCH),--arch $(ARCH)) dist

release: $(STAMP)  ## all files of a release with checksums, into dist/release-VERSION: make release [ARGS=--check, ARGS=--trial]
	$(BIN)/python scripts/release $(ARGS)

clean:  ## remove what the commands above made
	rm -rf $(VENV) $(SMALL) .uv build dist site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
