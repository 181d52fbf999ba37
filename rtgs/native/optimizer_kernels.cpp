namespace rtgs::RTGS_ISA {
}  // namespace rtgs::RTGS_ISA
