#!/bin/sh
# Installs Terrafix as a systemd service: virtual environment in /opt/terrafix, settings in /etc/terrafix.
#
#   sudo systemd/install.sh [--python /path/to/python3.13] [--prefix DIR] [--no-pip] [--package WHEEL]
#
# Run it again to upgrade: an existing /etc/terrafix/terrafix.toml is not changed. --prefix installs the files below
# DIR and starts nothing (for images and tests); --no-pip does not change the virtual environment. --package installs
# this wheel; default: the source tree that this file is in (`terrafix files DIR` copies it out of a wheel).
set -eu

here=$(cd "$(dirname "$0")" && pwd)
python=${PYTHON:-}
prefix=
pip=yes
package=$here/..
while [ $# -gt 0 ]; do
    case $1 in
        --python) python=$2; shift 2 ;;
        --prefix) prefix=$2; shift 2 ;;
        --no-pip) pip=no; shift ;;
        --package) package=$2; shift 2 ;;
        -h | --help) sed -n '2,/^set -eu/{/^#/s/^# \{0,1\}//p;}' "$0"; exit 0 ;;
        *) echo "install.sh: unknown option $1; see --help" >&2; exit 2 ;;
    esac
done
if [ -z "$prefix" ] && [ "$(id -u)" -ne 0 ]; then
    echo "install.sh: must be root; run it with sudo (or give --prefix)" >&2
    exit 2
fi

# gtsam 4.3 has wheels for Python 3.11 to 3.14; JetPack 6 includes 3.10 (docs/jetson.md describes how to install a
# newer one).
if [ "$pip" = yes ]; then
    if [ -d "$package" ] && [ ! -f "$package/pyproject.toml" ]; then
        echo "install.sh: $package is no source tree; give the wheel with --package" >&2
        exit 2
    fi
    for candidate in ${python:-python3 python3.14 python3.13 python3.12 python3.11}; do
        found=$("$candidate" --version 2>/dev/null) || continue
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))'; then
            chosen=$candidate
            break
        fi
        other=${other:-$found}
    done
    if [ -z "${chosen:-}" ]; then
        echo "install.sh: needs Python 3.11 to 3.14; found ${other:-none}. See docs/jetson.md, then give --python PATH" >&2
        exit 1
    fi
    "$chosen" -m venv "$prefix/opt/terrafix/venv"
    install=$prefix/opt/terrafix/venv/bin/pip
    "$install" install --upgrade --constraint "$here/../requirements.lock" "$package"
    # Without libsystemd-dev and a compiler it cannot be built; the log is then JSON in the text of the journal.
    "$install" install --constraint "$here/../requirements.lock" "${package}[vehicle]" ||
        echo "install.sh: no systemd-python (apt install libsystemd-dev gcc pkg-config): the journal gets no fields" >&2
    # The wheel of gtsam requires what tests it; nothing that flies imports that.
    "$install" uninstall --yes pytest pluggy iniconfig
fi

install -D -m 0644 "$here/terrafix.service" "$prefix/etc/systemd/system/terrafix.service"
install -D -m 0644 "$here/terrafix.sysusers.conf" "$prefix/usr/lib/sysusers.d/terrafix.conf"
install -D -m 0644 "$here/terrafix.tmpfiles.conf" "$prefix/usr/lib/tmpfiles.d/terrafix.conf"
install -D -m 0644 "$here/../config/default.toml" "$prefix/opt/terrafix/share/default.toml"
install -D -m 0644 "$here/../docs/jetson.md" "$prefix/opt/terrafix/share/jetson.md"
settings=$prefix/etc/terrafix/terrafix.toml
if [ -e "$settings" ]; then
    echo "kept $settings; all keys are explained in /opt/terrafix/share/default.toml"
else
    install -D -m 0644 "$here/../config/default.toml" "$settings"
fi

if [ -z "$prefix" ]; then
    systemd-sysusers terrafix.conf
    systemd-tmpfiles --create terrafix.conf
    systemctl daemon-reload
    echo "Next: set [source], [map] and [link] in /etc/terrafix/terrafix.toml, put the map into /var/lib/terrafix/maps,"
    echo "then: systemctl enable --now terrafix && journalctl -fu terrafix"
fi
