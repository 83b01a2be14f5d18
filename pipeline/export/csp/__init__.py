"""Export to the .mat files of convolutional social pooling."""
