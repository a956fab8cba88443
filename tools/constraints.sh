#!/usr/bin/env bash
# Write constraints.txt: the exact version of every direct and transitive dependency of all extras in setup.py, for
# Python 3.10 to 3.13 on x86-64 Linux. Run it to move to newer releases, or after you change a dependency in setup.py.
#
#     tools/constraints.sh            # keeps the versions that still fit
#     tools/constraints.sh --upgrade  # takes the newest releases; other options of `uv pip compile` work as well
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder" && "$folder/bin/pip" install --disable-pip-version-check -q uv
bundle=${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}
[ ! -e "$bundle" ] || export SSL_CERT_FILE=$bundle
echo "# Exact versions for make and CI, on Python 3.10 to 3.13 and x86-64 Linux. tools/constraints.sh writes this file." >"$folder/new"
cp constraints.txt "$folder/constraints.txt" 2>/dev/null || true
"$folder/bin/uv" pip compile setup.py --universal --python-version 3.10 --all-extras --no-annotate --no-header --quiet \
    --output-file "$folder/constraints.txt" "$@"
# what is true of every such machine need not stand 250 times
always=(-E)
for clause in "python_full_version < '3.14'" "implementation_name == 'cpython'" "platform_machine == 'x86_64'" \
    "sys_platform == 'linux'" "platform_python_implementation != 'PyPy'"; do
    always+=(-e "s/ and $clause//; s/; $clause and /; /; s/ ; $clause$//")
done
sed "${always[@]}" "$folder/constraints.txt" >>"$folder/new"
mv "$folder/new" constraints.txt
