#!/bin/sh
# Install the programs that the tests marked external run: Gmsh, CalculiX and FEniCSx, and pango, from Debian's or Ubuntu's packages.
# Where one cannot be had this says so and ends well: its tests are skipped with a reason.
set -u

say() {
    echo "external programs: $*"
}

missing=
# The system library of the extra pdf.
ldconfig -p 2>/dev/null | grep -q libpangoft2 || missing="$missing libpango-1.0-0 libpangoft2-1.0-0"
command -v gmsh >/dev/null 2>&1 || missing="$missing gmsh"
command -v ccx >/dev/null 2>&1 || missing="$missing calculix-ccx"
"${THERMOXELS_FENICSX_PYTHON:-/usr/bin/python3}" -c 'import dolfinx' >/dev/null 2>&1 || missing="$missing python3-dolfinx"
[ -n "$missing" ] || exit 0

if ! command -v apt-get >/dev/null 2>&1 || [ "$(id -u)" != 0 ]; then
    say "this machine lacks$missing, and installing packages takes apt-get and root; their tests are skipped"
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq || say "apt-get update failed; what it knew before is used"
for package in $missing; do
    say "installing $package"
    apt-get install -y -qq --no-install-recommends "$package" >/dev/null ||
        say "$package cannot be installed here; its tests are skipped"
done
exit 0
