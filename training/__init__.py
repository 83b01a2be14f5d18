"""Models, their training and their evaluation, on the tensors of a lake.

Each package says in its first line what it holds. It imports `schemas`, and the rules of `quality_reports` to judge
predicted scenes. torch is imported only where a model needs it.
"""
