#!/bin/sh
# Installs a container engine on Debian, as root: Podman with runc, names on its networks, and what makes base images
# where no registry can be reached. `make containers` then needs nothing else. Docker, where it is, is left as it is.
set -eu
if docker info >/dev/null 2>&1; then
  echo "Docker is here and is used"
  exit 0
fi
if ! command -v apt-get >/dev/null || [ "$(id -u)" != 0 ]; then
  echo "Podman can be installed here only as root with apt-get" >&2
  exit 1
fi
PACKAGES="podman buildah runc netavark aardvark-dns iptables mmdebstrap"
# shellcheck disable=SC2086 - words
if ! dpkg-query --show --showformat='' $PACKAGES 2>/dev/null; then
  apt-get update -qq
  # shellcheck disable=SC2086 - words
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $PACKAGES
fi
podman --version
