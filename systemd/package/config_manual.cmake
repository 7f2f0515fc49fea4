# Writes the manual's page of the configuration: HEAD, then CONFIG as it is, into OUT.
file(READ ${HEAD} page)
file(READ ${CONFIG} config)
# What troff would take for commands.
string(REPLACE "\\" "\\e" config "${config}")
string(REPLACE "\n." "\n\\&." config "${config}")
string(REPLACE "\n'" "\n\\&'" config "${config}")
string(REPLACE "-" "\\-" config "${config}")
file(WRITE ${OUT} "${page}.nf\n${config}.fi\n")
