"""Models, their training and their evaluation, on the tensors of a lake. It imports `schemas` and nothing else of ours.

Each package says in its first line what it holds. torch is imported only where a model needs it.
"""
