"""The stages of a capture as functions of values: they know nothing of when, where and in what order they are done."""
