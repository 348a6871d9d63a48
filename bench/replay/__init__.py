"""Position observers run on the host: beside a drive, over a recording, or over a capture."""
