#!/usr/bin/env bash
# Publish built packages with twine, which is installed by hash; at GitHub as a trusted publisher, without a password:
# publish.sh PACKAGES pypi|testpypi [OPTION of twine upload...]
set -euo pipefail
packages=$(cd "$1" && pwd)
repository=$2
shift 2
cd "$(dirname "${BASH_SOURCE[0]}")/.."
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python -m venv "$scratch/venv"
"$scratch/venv/bin/python" scripts/pinned_requirements.py --only twine >"$scratch/twine.txt"
"$scratch/venv/bin/python" -m pip install --quiet --no-deps --require-hashes -r "$scratch/twine.txt"
"$scratch/venv/bin/twine" upload --non-interactive --repository "$repository" "$@" "$packages"/*
