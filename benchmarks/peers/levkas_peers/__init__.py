"""Methods of registration of other programs and papers, for `levkas methods` from a checkout."""
