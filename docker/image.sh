#!/bin/sh
# Builds the image for several kinds of processors: sh docker/image.sh VERSION PLATFORMS [REPOSITORY]. With a repository, it
# is pushed there with a manifest of all. Kernels of another processor are compiled under emulation, which takes minutes.
set -eu
version=$1 platforms=$2 repository=${3:-}
name=${repository:-optipmb}:$version
images=
for platform in $(echo "$platforms" | tr , ' '); do
  arch=${platform#linux/} cpu=generic
  [ "$arch" != amd64 ] || cpu=x86-64-v3
  docker build --platform "$platform" --build-arg "CPU=$cpu" --build-arg "VERSION=$version" \
    --build-arg "REVISION=$(git rev-parse HEAD)" --build-arg "CREATED=$(git log -1 --format=%cI)" \
    --build-arg "SOURCE=$(git config --get remote.origin.url || true)" --file docker/Dockerfile --tag "$name-$arch" .
  [ -z "$repository" ] || docker push "$name-$arch"
  images="$images $name-$arch"
done
if [ -n "$repository" ]; then
  docker manifest create --amend "$name" $images
  docker manifest push "$name"
fi
