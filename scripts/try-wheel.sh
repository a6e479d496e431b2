#!/usr/bin/env bash
# Install a wheel with the pinned packages, hashes checked, into a fresh environment on this system, and use it on the
# sample log: try-wheel.sh WHEEL
set -euo pipefail
wheel=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
cd "$(dirname "${BASH_SOURCE[0]}")/.."
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python -m venv "$scratch/venv"
bin=$scratch/venv/bin
[[ -d $bin ]] || bin=$scratch/venv/Scripts
"$bin/python" scripts/pinned_requirements.py >"$scratch/pinned.txt"
"$bin/python" -m pip install --quiet --no-deps --require-hashes -r "$scratch/pinned.txt"
"$bin/python" -m pip install --quiet --no-deps "$wheel"
scripts/try-command.sh "$bin/icrtool" sample_logs/wheeled_lawnmower.mcap --robot segway-rmp400
