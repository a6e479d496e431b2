#!/usr/bin/env bash
# Build the wheel from a clean source archive, check it, install it as a tool (as uvx and pipx do), and run the demo there.
# A package file that was left out of the wheel, or an import of a development package, fails here and nowhere else.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-python3}
build_python=${BUILD_PYTHON:-.venv/bin/python}

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
tools=$(dirname "$build_python")
export UV_TOOL_DIR=$scratch/tools UV_TOOL_BIN_DIR=$scratch/bin UV_NO_CONFIG=1

echo "check-wheel: build"
"$build_python" -m build --installer uv --outdir "$scratch/dist" . >"$scratch/build.log" 2>&1 || { cat "$scratch/build.log" >&2; exit 1; }
wheel=$(ls "$scratch"/dist/*.whl)
"$build_python" -m twine check --strict "$scratch"/dist/* >"$scratch/twine.log" || { cat "$scratch/twine.log" >&2; exit 1; }
# W002: the same message definition stands in two packages of messages.
"$tools/check-wheel-contents" --no-config --ignore W002 "$wheel" >"$scratch/contents.log" || { cat "$scratch/contents.log" >&2; exit 1; }
"$build_python" -m zipfile --list "$wheel" >"$scratch/contents"
git ls-files --cached --others --exclude-standard icrtool | while read -r file; do
    [[ ! -e $file ]] || grep -qF "$file " "$scratch/contents" || { echo "check-wheel: $file is not in the wheel" >&2; exit 1; }
done

# Constraints hold no hashes for a local wheel's dependencies; the same files passed that test in `make setup-dev`.
echo "check-wheel: install"
sed -E -e '/^ +--hash/d' -e 's/ *\\$//' constraints.txt >"$scratch/pins.txt"
"$tools/uv" tool install --quiet --python "$python" --constraints "$scratch/pins.txt" "$wheel"

echo "check-wheel: run"
"$UV_TOOL_DIR/icrtool/bin/python" -I -c 'import icrtool, sys; sys.exit(not icrtool.__file__.startswith(sys.prefix))'
echo "check-wheel: types"
sed -n '/^```python/,/^```/p' README.md | sed '/^```/d' >"$scratch/readme.py"
cp tests/data/typed_use.py "$scratch/"
(cd "$scratch" && "$OLDPWD/$tools/mypy" --strict --no-incremental --python-executable "$UV_TOOL_DIR/icrtool/bin/python" \
    --disable-error-code no-untyped-call typed_use.py readme.py)
scripts/try-command.sh "$UV_TOOL_BIN_DIR/icrtool" >"$scratch/demo.txt"
echo "check-wheel: the wheel works"
