"""How good position estimates are on a recording, against a reference: figures, a rank, a report.

    metrics   statistics of an error, lags, of any number of samples
    phases    when the shaft stands, starts, runs steadily, changes speed, turns round
    reference what estimates are compared with: the encoder, the recording's own edges, an observer
    course    what the shaft does over a whole recording: a first pass over its angle
    tally     figures and plots of one observer, put together block by block
    tracks    a recording with the estimates of the drive and of observers run again on it
    board     all figures of every observer, by file and pooled, ranked
    table     the board as lines of text, JSON and CSV
    plots     error against time, angle and speed
    report    the board as one HTML file
    expect    bounds on figures, read, checked and written

An error is always the actual less the estimated value; from an observer as the reference there are differences.
"""
