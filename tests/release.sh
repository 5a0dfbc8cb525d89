#!/bin/sh
# Prepares a release and stops before publishing: a clean tree, the version in the changelog, all tests, both wheels and the source
# archive in dist/, checked. Called as: sh tests/release.sh BIN
set -eu
bin=$1
version=$("$bin/python" -c 'import optipmb; print(optipmb.__version__)')
[ -z "$(git status --porcelain)" ] || { echo "release: commit or remove what git status shows"; exit 1; }
grep -q "^## $version\( \|$\)" CHANGELOG.md || { echo "release: CHANGELOG.md has no section '## $version'"; exit 1; }
if grep -q "^## $version (unreleased)" CHANGELOG.md; then echo "release: CHANGELOG.md still calls $version unreleased"; exit 1; fi
if git rev-parse -q --verify "refs/tags/v$version" >/dev/null; then echo "release: the tag v$version is there already"; exit 1; fi
make test wheel accuracy alone
rm -rf dist
"$bin/python" -m build --outdir dist .
"$bin/python" -m build --wheel --outdir dist node
"$bin/python" -m twine check --strict dist/*
echo "release: dist/ is ready. To publish $version:"
echo "  git tag -a v$version -m 'OptiPMB $version' && git push origin v$version"
echo "  $bin/python -m twine upload dist/*"
