"""How weights of our own are made: from pictures of places at several dates to an ONNX file with its manifest.

Stays on the ground, and needs PyTorch (extra `train`); nothing else imports it. docs/training.md"""
