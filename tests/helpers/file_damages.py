"""What can become of a file of weights, and what is said of it."""

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
    weight = torch.load(path, weights_only=True)["first.weight"].numpy().tobytes()
    data = bytearray(path.read_bytes())
    data[bytes(data).index(weight) + 5] ^= 1
    path.write_bytes(bytes(data))


def write_list(path):
    torch.save([1, 2], path)


DAMAGES = {
    truncate: "damaged",
    cut_short: "damaged",
    empty: "damaged",
    write_noise: "damaged",
    write_code: "damaged",
    write_torch_code: "damaged, or .* holds objects that could run code, and was not read",
    write_old_torch_code: "damaged",
    flip_a_bit: "damaged, or .*`.*/data/[0-9]+` has another checksum",
    write_list: "damaged, or not the weights of this model .*list",
}
