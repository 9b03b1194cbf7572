"""Methods of registration of other programs and papers, for benchmarks/methods.py."""
