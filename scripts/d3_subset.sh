#!/bin/sh
# Build icrtool/output/page/static/vendor/d3-subset.min.js: the functions of d3 that map.js calls, in one file.
# Needs node 20 and npm. The result is committed; run this again only for another version or another function.
set -eu
vendor=$(cd "$(dirname "$0")/../icrtool/output/page/static/vendor" && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > entry.js <<'ENTRY'
export { extent, range } from "d3-array";
export { axisBottom, axisLeft } from "d3-axis";
export { color } from "d3-color";
export { format } from "d3-format";
export { quadtree } from "d3-quadtree";
export { scaleLinear } from "d3-scale";
export { pointer, select } from "d3-selection";
export { zoom, zoomIdentity } from "d3-zoom";
ENTRY
npm init -y > package.txt
npm install --no-audit --no-fund --save-exact \
    d3-array@3.2.5 d3-axis@3.0.1 d3-color@3.1.1 d3-format@3.1.3 d3-quadtree@3.0.2 d3-scale@4.0.3 \
    d3-selection@3.0.1 d3-zoom@3.0.1 esbuild@0.28.2 >&2
npx esbuild entry.js --bundle --minify --format=iife --global-name=d3 --target=es2020 --charset=utf8 \
    --banner:js="// Functions of d3 (https://d3js.org), Copyright Mike Bostock, ISC; made by scripts/d3_subset.sh" \
    --outfile="$vendor/d3-subset.min.js"
sha256sum "$vendor/d3-subset.min.js"
