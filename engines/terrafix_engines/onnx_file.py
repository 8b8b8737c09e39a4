"""ONNX files, encoded by hand (onnx.proto3, protocol buffers): graphs of a few nodes that this project makes itself, so
that neither their export nor tests need the package onnx."""

import numpy as np

Shape = list[int | str]
TYPES = {"float32": 1, "int32": 6, "int64": 7, "float16": 10}  # TensorProto.DataType
IR_VERSION, OPSET = 8, 17  # of ONNX 1.12: ONNX Runtime 1.12, TensorRT 8.5 and newer read them


def _varint(value: int) -> bytes:
    out = bytearray()
    value &= (1 << 64) - 1
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _block(field: int, content: bytes | str) -> bytes:
    content = content.encode() if isinstance(content, str) else content
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def tensor(name: str, array: np.ndarray) -> bytes:
    """-> TensorProto of an initializer."""
    dims = b"".join(_number(1, size) for size in array.shape)
    return dims + _number(2, TYPES[array.dtype.name]) + _block(8, name) + _block(9, array.tobytes())


def node(kind: str, inputs: list[str], outputs: list[str], **ints: int | list[int]) -> bytes:
    """-> NodeProto. Attributes are integers or lists of integers."""
    body = b"".join(_block(1, name) for name in inputs) + b"".join(_block(2, name) for name in outputs)
    body += _block(4, kind)
    for name, value in ints.items():
        if isinstance(value, int):
            attribute = _block(1, name) + _number(3, value) + _number(20, 2)
        else:
            attribute = _block(1, name) + b"".join(_number(8, one) for one in value) + _number(20, 7)
        body += _block(5, attribute)
    return body


def value(name: str, shape: Shape, dtype: str = "float32") -> bytes:
    """-> ValueInfoProto of an input or output."""
    dims = b"".join(_block(1, _number(1, s) if isinstance(s, int) else _block(2, s)) for s in shape)
    return _block(1, name) + _block(2, _block(1, _number(1, TYPES[dtype]) + _block(2, dims)))


def model(
    nodes: list[bytes], initializers: list[bytes], inputs: list[bytes], outputs: list[bytes], name: str = "graph"
) -> bytes:
    """-> ModelProto with opset OPSET: the content of a file."""
    graph = b"".join(_block(1, one) for one in nodes) + _block(2, name)
    graph += b"".join(_block(5, one) for one in initializers)
    graph += b"".join(_block(11, one) for one in inputs) + b"".join(_block(12, one) for one in outputs)
    return _number(1, IR_VERSION) + _block(7, graph) + _block(8, _number(2, OPSET))
