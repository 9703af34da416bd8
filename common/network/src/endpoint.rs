//! Zenoh endpoints in a user's configuration: `tcp/ADDRESS:PORT` or `udp/ADDRESS:PORT`, and
//! `tls/ADDRESS:PORT` where the session is secure.

use std::net::SocketAddr;

use zenoh::config::EndPoint;

use crate::error::NetworkError;

/// Parses an endpoint and checks its protocol.
fn parse(endpoint: &str) -> Result<EndPoint, String> {
    let form = "is no endpoint. Write it tcp/ADDRESS:PORT, udp/ADDRESS:PORT or tls/ADDRESS:PORT";
    let parsed: EndPoint = endpoint.parse().map_err(|_| form.to_owned())?;
    if !["tcp", "udp", "tls"].contains(&parsed.protocol().as_str()) {
        return Err(form.into());
    }
    Ok(parsed)
}

/// Checks each endpoint of a list, which is the parameter `field`.
///
/// # Errors
/// [`NetworkError::Parameter`] names the first refused endpoint, and the cure.
pub fn check_each(
    field: &str,
    endpoints: &[String],
    check: impl Fn(&str) -> Result<(), String>,
) -> Result<(), NetworkError> {
    endpoints.iter().enumerate().try_for_each(|(index, endpoint)| {
        check(endpoint).map_err(|reason| {
            NetworkError::parameter(&format!("{field}[{index}]"), endpoint, reason)
        })
    })
}

/// Refuses unencrypted links where the session is secure, and encrypted links where there are no
/// certificates.
///
/// # Errors
/// The reason, and a valid form.
pub fn check_protocol(endpoint: &str, is_secure: bool) -> Result<(), String> {
    match (parse(endpoint)?.protocol().as_str(), is_secure) {
        ("tls", false) => Err("needs certificates. Cure: security, or tcp/ADDRESS:PORT".into()),
        ("tcp" | "udp", true) => Err("is not protected. Cure: tls/ADDRESS:PORT".into()),
        _ => Ok(()),
    }
}

/// Refuses an endpoint to listen on that is not one address of this machine, or one interface.
///
/// # Errors
/// The reason, and a valid form.
pub fn check_listen(endpoint: &str) -> Result<(), String> {
    let address = listen_address(endpoint)?;
    let on_one_interface =
        !address.ip().is_unspecified() || parse(endpoint)?.config().get("iface").is_some();
    if !on_one_interface {
        let port = address.port();
        return Err(format!(
            "would listen on every interface. Cure: the address of one, or #iface=NAME \
             (tcp/0.0.0.0:{port}#iface=wlan0)"
        ));
    }
    Ok(())
}

/// Address and port of an endpoint to listen on.
pub(crate) fn listen_address(endpoint: &str) -> Result<SocketAddr, String> {
    let parsed = parse(endpoint)?;
    let address = parsed.address();
    address.as_str().parse().map_err(|_| {
        format!("needs an IP address and a port (not '{}'), 0 for any port", address.as_str())
    })
}

/// Refuses an endpoint that cannot be connected to.
///
/// # Errors
/// The reason, and a valid form.
pub fn check_connect(endpoint: &str) -> Result<(), String> {
    let parsed = parse(endpoint)?;
    let address = parsed.address();
    let address = address.as_str();
    match address.parse::<SocketAddr>() {
        Ok(parsed) if parsed.port() == 0 => return Err("needs a port other than 0".into()),
        Ok(_) => return Ok(()),
        // Zenoh resolves names of UDP endpoints while it opens, and fails if it cannot.
        Err(_) if parsed.protocol().as_str() == "udp" => {
            return Err("needs an IP address and a port (names work with tcp and tls only)".into());
        }
        Err(_) => {}
    }
    match address.rsplit_once(':') {
        Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok_and(|p| p != 0) => {
            Ok(())
        }
        _ => Err("needs a host and a port".into()),
    }
}
