"""Figures of the acceptance suite: captures or arrays in, a matplotlib figure out. Nothing here measures or waits."""
