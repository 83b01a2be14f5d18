"""What can become of a file of tensors, and what is said of it."""

import os
import pickle
import random

import torch


class Code:
    """Unpickled by the usual means, it makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return (os.mkdir, (self.path,))


def truncate(path):
    path.write_bytes(path.read_bytes()[:-200])


def cut_short(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path):
    path.write_bytes(b"")


def write_noise(path):
    path.write_bytes(random.Random(0).randbytes(5000))


def write_code(path):
    path.write_bytes(pickle.dumps({"network": Code(path.parent / "was run")}))


def write_torch_code(path):
    torch.save({"network": Code(path.parent / "was run")}, path)


def write_old_torch_code(path):
    torch.save({"network": Code(path.parent / "was run")}, path, _use_new_zipfile_serialization=False)


def flip_a_bit(path):
    """Change a byte of a weight: the file is as long, and torch reads it as if nothing were wrong."""
    content = torch.load(path, weights_only=True)
    weight = content.get("network", content)["first.weight"].numpy().tobytes()
    data = bytearray(path.read_bytes())
    data[bytes(data).index(weight) + 5] ^= 1
    path.write_bytes(bytes(data))


def write_list(path):
    torch.save([1, 2], path)


DAMAGES = {
    truncate: "damaged or no file of torch's",
    cut_short: "damaged or no file of torch's",
    empty: r"damaged or no file of torch's \(0 bytes",
    write_noise: r"damaged or no file of torch's \(5,000 bytes",
    write_code: "damaged or no file of torch's",
    write_torch_code: "expected tensors and plain values, got objects that could run code, and did not read them",
    write_old_torch_code: "damaged or no file of torch's",
    flip_a_bit: "damaged or no file of torch's .*`.*/data/[0-9]+` has another checksum",
    write_list: "expected values by name, got list",
}
