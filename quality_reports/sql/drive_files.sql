-- Raw files of a drive with their sha256.
-- $drive: its name.
SELECT source.file, source.sha256
FROM (SELECT unnest(source_files) AS source FROM drives WHERE subset = $drive AND dataset = 'v2v')
ORDER BY source.file
