# make run    installs what is missing, builds, and shows 20 s of the default pipeline on its
#             simulated flight, with the errors against the truth
# make test   formatting, clippy, unit, doc and whole-pipeline tests
# make bench  what it costs: functions, the hop between processes, the whole pipeline
# make setup  only installs the missing Debian packages

SHELL := /bin/bash
FOR ?= 20s

.PHONY: run test bench build setup cargo format

run: build
	target/release/flockeye up --for $(FOR)

build: setup
	cargo build --release --workspace --locked

# Tests run the binaries, so these are built first, with the tests, so that the dependencies are
# built once; clippy reads the benchmarks too. Cargo.toml says what the profile is.
test: setup
	cargo fmt --all --check
	cargo clippy --profile tested --workspace --all-targets --locked -- -D warnings
	cargo build --profile tested --workspace --bins --tests --locked
	cargo test --profile tested --workspace --locked -- --test-threads=2

bench: setup
	cargo build --release --workspace --all-targets --locked
	cargo bench --workspace --locked --bench rectify --bench corners --bench align --bench render --bench hop --bench pipeline

format:
	cargo fmt --all

setup: cargo
	@deploy/setup

cargo:
	@command -v cargo >/dev/null || { echo "Rust is missing. Cure: install it as https://rustup.rs says, then open a new shell."; exit 1; }
