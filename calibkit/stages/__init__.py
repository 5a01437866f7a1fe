"""One function a command: files -> result, the pipeline in reading order."""
