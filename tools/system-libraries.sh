#!/bin/sh
# Install the named Debian packages that are missing. Not root, or not Debian: print the line and go on.
set -u
missing=""
if ! command -v dpkg-query >/dev/null 2>&1; then
    exit 0
fi
for package in "$@"; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "install ok installed" || missing="$missing $package"
done
[ -z "$missing" ] && exit 0
if [ "$(id -u)" -ne 0 ]; then
    echo "missing system libraries; going on with what works. To install them:"
    echo "  sudo apt-get install -y$missing"
    exit 0
fi
echo "installing system libraries:$missing"
export DEBIAN_FRONTEND=noninteractive
{ apt-get update -qq && apt-get install -y -qq --no-install-recommends $missing; } >/dev/null || {
    echo "could not install:$missing (going on with what works; see \`dnrpipe doctor\`)"
}
exit 0
