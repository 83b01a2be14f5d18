-- Size of a drive's ego; null where unknown.
-- $drive: its name.
SELECT ego_length_m AS length_m, ego_width_m AS width_m FROM drives WHERE subset = $drive AND dataset = 'v2v'
