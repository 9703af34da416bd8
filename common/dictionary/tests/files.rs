//! Every dictionary that can be named, and files that are none.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_dictionary::{Dictionary, PREDEFINED};

#[test]
fn every_predefined_dictionary_is_known() {
    for name in PREDEFINED {
        let dictionary = Dictionary::load(name).expect(name);
        let count: usize = match name {
            "DICT_ARUCO_ORIGINAL" => 1024,
            "DICT_APRILTAG_16h5" => 30,
            "DICT_APRILTAG_25h9" => 35,
            "DICT_APRILTAG_36h10" => 2320,
            "DICT_APRILTAG_36h11" => 587,
            "DICT_ARUCO_MIP_36h12" => 250,
            _ => name.rsplit('_').next().unwrap().parse().unwrap(),
        };
        assert_eq!((dictionary.name(), dictionary.marker_count()), (name, count));
        let cells = dictionary.prints().iter().map(|print| print.cells()).max();
        assert_eq!(cells, Some(dictionary.bits() + 2));
    }
}

#[test]
fn a_broken_dictionary_file_is_refused_with_what_is_wrong() {
    let path = std::env::temp_dir().join(format!("flockeye-dictionary-{}.yml", std::process::id()));
    for (text, expected) in [
        ("%YAML:1.0\nmarkersize: 4\n", "nmarkers"),
        ("%YAML:1.0\nnmarkers: 1\nmarkersize: 4\nmarker_0: \"01010101\"\n", "marker_0"),
        ("%YAML:1.0\nnmarkers: 2\nmarkersize: 2\nmarker_0: \"0110\"\n", "marker_1"),
        ("no dictionary at all", "dictionary file"),
    ] {
        std::fs::write(&path, text).unwrap();
        let error = Dictionary::load(path.to_str().unwrap()).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    std::fs::File::create(&path).unwrap().set_len(100 << 20).unwrap();
    let error = Dictionary::load(path.to_str().unwrap()).unwrap_err().to_string();
    assert!(error.contains("104857600 bytes"), "{error}");
    std::fs::remove_file(&path).unwrap();
}
