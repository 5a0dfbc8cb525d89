#!/bin/sh
# Prepares a release and stops before publishing: a clean tree, the version in the changelog, all tests, all wheels and the source
# archive in dist/, checked. Called as: sh tests/release.sh BIN
set -eu
bin=$1
version=$("$bin/python" -c 'import optipmb; print(optipmb.__version__)')
[ -z "$(git status --porcelain)" ] || { echo "release: commit or remove what git status shows"; exit 1; }
grep -q "^## $version\( \|$\)" CHANGELOG.md || { echo "release: CHANGELOG.md has no section '## $version'"; exit 1; }
if grep -q "^## $version (unreleased)" CHANGELOG.md; then echo "release: CHANGELOG.md still calls $version unreleased"; exit 1; fi
if git rev-parse -q --verify "refs/tags/v$version" >/dev/null; then echo "release: the tag v$version is there already"; exit 1; fi
# Addresses of a repository that has none yet; tests and documents name others of this kind as examples.
places=$(git grep -l 'example\.invalid/optipmb\|@example\.invalid' -- ':!tests' || true)
[ -z "$places" ] || { echo "release: put addresses in the place of example.invalid in" $places; exit 1; }
make test wheel accuracy alone
rm -rf dist && mkdir -p out
"$bin/python" -m build --outdir dist .
"$bin/python" -m build --wheel --outdir dist node
make wheels DIST=dist
"$bin/python" -m twine check --strict dist/*
# What is in the image: a list with licences, and what is known against it. Packages that no database can be asked about are named.
"$bin/python" -m venv --clear --without-pip out/image-env
"$bin/python" -m pip --python out/image-env install --quiet --no-deps --require-hashes --requirement docker/requirements.lock
"$bin/python" -m cyclonedx_py environment out/image-env --output-file out/sbom.cdx.json
"$bin/python" packaging/licences.py out/sbom.cdx.json >out/licences.txt
rm -rf out/audit
"$bin/python" -m pip install --quiet --target out/audit "pip-audit>=2.9,<3"
PYTHONPATH=out/audit "$bin/python" -m pip_audit --no-deps --disable-pip --requirement docker/requirements.lock
echo "release: dist/ is ready. To publish $version:"
echo "  git tag -a v$version -m 'OptiPMB $version' && git push origin v$version"
echo "  $bin/python -m twine upload dist/*"
echo "  make image PUSH=REGISTRY/optipmb       # for amd64 and arm64, with out/sbom.cdx.json beside it"
echo "  make demo-files                         # out/demo/demo.mcap and demo.rrd, for the addresses in docs/watching.md"
