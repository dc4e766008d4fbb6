"""Weights that come with the package: `mrcdrl.common.runtime.pretrained`."""
