"""Exports the policy of a run as an ONNX file, for `gym_mara.deploy`."""
