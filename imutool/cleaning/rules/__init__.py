"""The rules, one file each; the file's name is the rule's, and every file here is found (`imutool.registry`)."""
