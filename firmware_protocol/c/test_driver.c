/* SPDX-License-Identifier: BSD-3-Clause
 *
 * The library as a shared object, for the tests to drive from Python. Python mirrors the structs;
 * the sizes here tell it when a mirror is out of date.
 */
#define TAXELD_PROTOCOL_IMPLEMENTATION
#include "taxeld_protocol.h"

const size_t driver_sizes[] = {
    sizeof(taxeld_packet),          sizeof(taxeld_frame),        sizeof(taxeld_module),
    sizeof(taxeld_request),         sizeof(taxeld_hub),          sizeof(taxeld_scan),
    sizeof(taxeld_fragmenter),      sizeof(taxeld_link_counters), sizeof(taxeld_reassembler),
    sizeof(taxeld_serial_counters), sizeof(taxeld_receiver),
};
