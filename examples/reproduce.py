"""``ocwm reproduce`` as a script: ``python examples/reproduce.py`` takes the same settings."""

from torchrl_ocwm.console import run

if __name__ == "__main__":
    run("reproduce")
