"""``ocwm train-online`` as a script: ``python examples/train_online.py`` takes the same settings."""

from torchrl_ocwm.console import run

if __name__ == "__main__":
    run("train-online")
