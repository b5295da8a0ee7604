//! Where webhooks may lead: addresses of the public internet, and those that the service's owner lists.
//!
//! Who may submit jobs could otherwise make the service ask its own machine, its neighbours or a cloud's metadata server. Names
//! say nothing, so addresses are judged, after resolution, and the connection goes to an address that was judged.

use std::net::IpAddr;

use url::{Host, Url};

use crate::config::IpNetwork;

/// Letters of an address.
const MAX_URL_CHARS: usize = 2000;

/// IPv4 addresses that are not of the public internet (IANA's registry of special-purpose addresses, multicast, reserved).
const SPECIAL_V4: [IpNetwork; 16] = [
    IpNetwork::v4([0, 0, 0, 0], 8),
    IpNetwork::v4([10, 0, 0, 0], 8),
    IpNetwork::v4([100, 64, 0, 0], 10),
    IpNetwork::v4([127, 0, 0, 0], 8),
    IpNetwork::v4([169, 254, 0, 0], 16),
    IpNetwork::v4([172, 16, 0, 0], 12),
    IpNetwork::v4([192, 0, 0, 0], 24),
    IpNetwork::v4([192, 0, 2, 0], 24),
    IpNetwork::v4([192, 88, 99, 0], 24),
    IpNetwork::v4([192, 168, 0, 0], 16),
    IpNetwork::v4([198, 18, 0, 0], 15),
    IpNetwork::v4([198, 51, 100, 0], 24),
    IpNetwork::v4([203, 0, 113, 0], 24),
    // Of a cloud's own services.
    IpNetwork::v4([168, 63, 129, 16], 32),
    IpNetwork::v4([224, 0, 0, 0], 4),
    IpNetwork::v4([240, 0, 0, 0], 4),
];
/// The only IPv6 addresses of the public internet ...
const GLOBAL_V6: IpNetwork = IpNetwork::v6(0x2000, 0, 3);
/// ... but for these: protocol assignments (Teredo among them), documentation, and 6to4, which leads to any IPv4 address.
const SPECIAL_V6: [IpNetwork; 4] = [
    IpNetwork::v6(0x2001, 0, 23),
    IpNetwork::v6(0x2001, 0xdb8, 32),
    IpNetwork::v6(0x2002, 0, 16),
    IpNetwork::v6(0x3fff, 0, 20),
];

/// Whether an address is one of the public internet. One that only wraps an IPv4 address is not.
pub fn is_public(address: IpAddr) -> bool {
    let special: &[IpNetwork] = if address.is_ipv4() { &SPECIAL_V4 } else { &SPECIAL_V6 };
    (address.is_ipv4() || GLOBAL_V6.contains(address)) && !special.iter().any(|network| network.contains(address))
}

/// Why an address of a webhook was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidTarget {
    /// It can't be read.
    #[error("the webhook's url can't be read: {0}")]
    Syntax(String),
    /// It is longer than 2000 letters.
    #[error("the webhook's url is too long")]
    TooLong,
    /// Neither http nor https.
    #[error("the webhook's url must begin with http:// or https://")]
    Scheme,
    /// It names a user or a password.
    #[error("the webhook's url must not hold a user or password")]
    Credentials,
    /// It leads to an address that is neither public nor listed.
    #[error("the webhook's host is not a public address")]
    NotPublic,
}

/// A webhook's address, read and found acceptable as far as it can be without asking for its host's addresses.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Target {
    url: Url,
}

impl Target {
    /// Reads an address. Every way to write an IP address (decimal, octal, hexadecimal, shortened, in other digits) is
    /// understood, and judged as the address it means.
    ///
    /// # Errors
    /// Why it is refused.
    pub fn parse(text: &str, allowed: &[IpNetwork]) -> Result<Self, InvalidTarget> {
        if text.chars().count() > MAX_URL_CHARS {
            return Err(InvalidTarget::TooLong);
        }
        let url = Url::parse(text).map_err(|error| InvalidTarget::Syntax(error.to_string()))?;
        if !matches!(url.scheme(), "http" | "https") {
            return Err(InvalidTarget::Scheme);
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err(InvalidTarget::Credentials);
        }
        let literal = match url.host() {
            Some(Host::Ipv4(address)) => Some(IpAddr::V4(address)),
            Some(Host::Ipv6(address)) => Some(IpAddr::V6(address)),
            Some(Host::Domain(_)) => None,
            None => return Err(InvalidTarget::Syntax("it has no host".to_owned())),
        };
        if literal.is_some_and(|address| !may_connect(address, allowed)) {
            return Err(InvalidTarget::NotPublic);
        }
        Ok(Self { url })
    }

    /// The address as it is called.
    pub fn url(&self) -> &Url {
        &self.url
    }

    /// The host's name, or its IP address without brackets.
    pub(super) fn host(&self) -> String {
        match self.url.host() {
            Some(Host::Ipv6(address)) => address.to_string(),
            Some(host) => host.to_string(),
            None => String::new(),
        }
    }

    pub(super) fn port(&self) -> u16 {
        self.url.port_or_known_default().unwrap_or(443)
    }

    pub(super) fn is_encrypted(&self) -> bool {
        self.url.scheme() == "https"
    }
}

/// Whether webhooks may lead to an address.
pub(super) fn may_connect(address: IpAddr, allowed: &[IpNetwork]) -> bool {
    is_public(address) || allowed.iter().any(|network| network.contains(address))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn only_addresses_of_the_public_internet_are_public() {
        for address in ["8.8.8.8", "1.1.1.1", "172.32.0.1", "100.128.0.1", "2606:4700::1111", "2a00:1450::1"] {
            assert!(is_public(address.parse().unwrap()), "{address}");
        }
        for address in [
            "0.0.0.0",
            "10.1.2.3",
            "100.64.0.1",
            "100.127.255.255",
            "127.0.0.1",
            "127.255.255.254",
            "169.254.169.254",
            "172.16.0.1",
            "172.31.255.255",
            "192.0.0.8",
            "192.0.2.1",
            "192.88.99.1",
            "192.168.1.1",
            "198.19.0.1",
            "198.51.100.7",
            "203.0.113.9",
            "168.63.129.16",
            "224.0.0.1",
            "239.1.1.1",
            "240.0.0.1",
            "255.255.255.255",
            "::",
            "::1",
            "::ffff:8.8.8.8",
            "::ffff:127.0.0.1",
            "::127.0.0.1",
            "64:ff9b::7f00:1",
            "64:ff9b::808:808",
            "100::1",
            "fc00::1",
            "fd00:ec2::254",
            "fe80::1",
            "fec0::1",
            "ff02::1",
            "2001::1",
            "2001:db8::1",
            "2002:7f00:1::",
            "3fff::1",
        ] {
            assert!(!is_public(address.parse().unwrap()), "{address}");
        }
    }
}
