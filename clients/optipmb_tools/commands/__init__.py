"""The commands of `optipmb`: each module turns options into one call, and its result into text or JSON.

Results go to standard output, everything else to standard error. What only some commands need is imported inside them:
`optipmb --help` shall not wait for compilers and plotting libraries.
"""
