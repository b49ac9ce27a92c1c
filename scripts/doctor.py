"""Check the installation and the machine, and say in plain words what is wrong and what to do about it."""

import sys

try:
    from soma_bullet.cli.doctor import doctor
except ImportError as error:
    sys.exit(
        f"error: the package soma_bullet does not load ({error}); in the checkout: pip install --editable ."
    )

if __name__ == "__main__":
    sys.exit(doctor())
