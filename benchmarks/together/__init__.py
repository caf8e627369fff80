"""Several processes that train one model, beside one process with as many views per step."""
