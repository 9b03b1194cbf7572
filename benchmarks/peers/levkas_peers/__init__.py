"""Methods of registration of other programs and papers, for `levkas evaluate --compare` from a checkout."""
