"""The terms of the paper's total loss and what they are made of."""
