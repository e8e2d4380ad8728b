"""``ocwm evaluate`` as a script: ``python examples/evaluate.py`` takes the same settings."""

from torchrl_ocwm.console import run

if __name__ == "__main__":
    run("evaluate")
