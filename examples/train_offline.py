"""``ocwm train`` as a script: ``python examples/train_offline.py`` takes the same settings."""

from torchrl_ocwm.console import run

if __name__ == "__main__":
    run("train")
