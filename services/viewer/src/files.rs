//! The page itself: files that are compiled into this program. Nothing else is ever served.

#[derive(Debug, PartialEq, Eq)]
pub(crate) struct PageFile {
    /// Its path in the address.
    pub path: &'static str,
    pub media_type: &'static str,
    pub content: &'static [u8],
}

/// The page's content security policy: nothing from elsewhere, nothing inline.
pub(crate) const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; \
     connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

macro_rules! files {
    ($($path:literal => $media_type:literal, $file:literal;)+) => {
        /// All files of the page.
        pub(crate) const FILES: &[PageFile] = &[$(PageFile {
            path: $path,
            media_type: $media_type,
            content: include_bytes!(concat!("../page/", $file)),
        }),+];
    };
}

files! {
    "/" => "text/html; charset=utf-8", "index.html";
    "/style.css" => "text/css; charset=utf-8", "style.css";
    "/icon.svg" => "image/svg+xml", "icon.svg";
    "/main.js" => "text/javascript; charset=utf-8", "main.js";
    "/link.js" => "text/javascript; charset=utf-8", "link.js";
    "/history.js" => "text/javascript; charset=utf-8", "history.js";
    "/shader.js" => "text/javascript; charset=utf-8", "shader.js";
    "/maths.js" => "text/javascript; charset=utf-8", "maths.js";
    "/bodies.js" => "text/javascript; charset=utf-8", "bodies.js";
    "/sphere.js" => "text/javascript; charset=utf-8", "sphere.js";
    "/overlay.js" => "text/javascript; charset=utf-8", "overlay.js";
    "/space.js" => "text/javascript; charset=utf-8", "space.js";
    "/playback.js" => "text/javascript; charset=utf-8", "playback.js";
    "/panels.js" => "text/javascript; charset=utf-8", "panels.js";
    "/explain.js" => "text/javascript; charset=utf-8", "explain.js";
    "/timelines.js" => "text/javascript; charset=utf-8", "timelines.js";
}

pub(crate) fn find(path: &str) -> Option<&'static PageFile> {
    FILES.iter().find(|file| file.path == path)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The policy lets nothing inline run, and nothing come from elsewhere; so there must be none.
    #[test]
    fn the_page_needs_nothing_from_elsewhere_and_nothing_inline() {
        for file in FILES {
            let text = String::from_utf8_lossy(file.content);
            for forbidden in
                ["http://", "https://", "eval(", "innerHTML", "<style", "onclick=", "style="]
            {
                // A name of a language of pictures is no address that is ever fetched.
                let text = text.replace("http://www.w3.org/2000/svg", "");
                assert!(!text.contains(forbidden), "{forbidden} in {}", file.path);
            }
        }
    }

    #[test]
    fn every_script_that_is_imported_is_carried() {
        for file in FILES {
            let text = String::from_utf8_lossy(file.content).into_owned();
            for (_, rest) in text.match_indices(" from \"./").map(|(at, _)| text.split_at(at)) {
                let name = rest.split('"').nth(1).map(|name| name.trim_start_matches('.'));
                assert!(name.and_then(find).is_some(), "{name:?} of {}", file.path);
            }
        }
    }
}
