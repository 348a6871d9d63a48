"""A recorded run in the formats of other tools: each opens it without hallbench.

content       what is exported: tables with names, units, times and gaps; what was said; what the run is
export        the choice of the format, checks, and files that appear whole or not at all
arrow         the tables as Arrow tables, each with a file of its own
to_csv, to_mat, to_mdf4, to_npz, to_parquet, to_rrd    one format each
"""

ENDINGS = {"csv": ".csv", "mdf4": ".mf4", "mat": ".mat", "npz": ".npz", "rrd": ".rrd", "parquet": ".parquet"}
"""How files of each format end."""
