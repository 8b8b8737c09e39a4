"""Training of the feature network: from images of places at several dates to an ONNX file with its manifest.

Runs on the ground and needs PyTorch (extra `train`); no other package imports it. docs/training.md"""
