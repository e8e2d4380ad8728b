"""``python -m torchrl_ocwm.check``: can environments be simulated and rendered here? If not: what to install."""

from __future__ import annotations

import sys


def main() -> int:
    """Make each environment whose simulator is installed, and say how it went on one line each."""
    try:
        from torchrl_ocwm.envs import ENVIRONMENTS, make_env
        from torchrl_ocwm.envs.registry import not_installed

        for name, environment in ENVIRONMENTS.items():
            if (error := not_installed(environment)) is not None:
                sys.stdout.write(f"{error}\n")
                continue
            make_env(name).close()
            sys.stdout.write(f"{name}: simulates and renders\n")
    except (ImportError, RuntimeError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
