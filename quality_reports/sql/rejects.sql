-- The first $rejects_per_file dropped rows of every file, as in the file, cut after $reject_characters.
SELECT
    dataset, file, recording, line, reason, left(text, $reject_characters) AS text,
    length(text) > $reject_characters AS cut, count(*) OVER (PARTITION BY dataset, file) AS rejects_in_file
FROM rejects
QUALIFY row_number() OVER (PARTITION BY dataset, file ORDER BY line) <= $rejects_per_file
ORDER BY dataset, file, line
