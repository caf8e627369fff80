"""The stages that are measured; each file makes the ``Timing``s of its groups."""
