"""A workspace's results in other tools' formats: images and cameras, ONNX, glTF, a page for the browser."""
