"""Export in the format of convolutional social pooling."""
