#!/bin/sh
# nginx for the test of deploy/nginx.conf, unpacked into the folder $1 and not installed: the package would start a web
# server. Where it cannot be had, that test is skipped and says so.
set -u
for found in "$1/usr/sbin/nginx" /usr/sbin/nginx; do
    [ -x "$found" ] && exit 0
done
command -v dpkg >/dev/null 2>&1 && command -v apt-get >/dev/null 2>&1 || exit 0
mkdir -p "$1" && cd "$1" || exit 0
apt-get download -qq nginx >/dev/null 2>&1 || {
    [ "$(id -u)" -eq 0 ] && apt-get update -qq >/dev/null 2>&1
    apt-get download -qq nginx >/dev/null 2>&1
}
for package in nginx_*.deb; do
    [ -f "$package" ] && dpkg -x "$package" . && rm "$package"
done
exit 0
