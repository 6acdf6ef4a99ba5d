"""What methods that align a map share: from a state vector and its prior to a posterior and its probability.

docs/methods/index.md says which module holds what.
"""
