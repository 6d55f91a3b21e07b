/* SPDX-License-Identifier: BSD-3-Clause */
#define TAXELD_PROTOCOL_IMPLEMENTATION
#include "taxeld_protocol.h"

#define UID 0x05C10001u /* another for each hub */
#define MODULES 8
#define CHANNELS 11 /* of each module: T0 to T10 */

/* The board: these four are yours. */
size_t board_read(uint8_t *bytes, size_t room); /* waits a millisecond at most */
void board_write(const uint8_t *bytes, size_t n);
uint32_t board_ms(void);
void board_counts(uint16_t *counts, size_t n); /* module by module */

static taxeld_module module[MODULES];
static taxeld_hub hub;

static void say(const uint8_t *packet, int n)
{
    uint8_t line[TAXELD_LINE_MAX];

    n = taxeld_serial_encode(line, sizeof line, packet, (size_t)n, hub.short_id);
    if (n > 0)
        board_write(line, (size_t)n);
}

static void send_scan(void)
{
    uint8_t packet[TAXELD_PACKET_MAX], channels[MODULES];
    uint16_t counts[MODULES * CHANNELS];
    taxeld_scan scan;
    int n;

    board_counts(counts, MODULES * CHANNELS);
    taxeld_channels(channels, module, MODULES);
    taxeld_scan_init(&scan, channels, MODULES, 0, 0, counts, MODULES * CHANNELS);
    while ((n = taxeld_scan_next(&scan, packet, sizeof packet)) > 0)
        say(packet, n);
}

int main(void)
{
    static taxeld_receiver receiver;
    uint8_t bytes[64], packet[TAXELD_PACKET_MAX];
    taxeld_packet request;
    uint32_t last_ms = 0;

    for (uint32_t i = 0; i < MODULES; i++) {
        module[i].sui = i + 1;
        module[i].mask = (1u << CHANNELS) - 1;
        module[i].channels = CHANNELS;
    }
    taxeld_hub_init(&hub, UID, module, MODULES, TAXELD_RUNNING);
    for (;;) {
        size_t left = board_read(bytes, sizeof bytes);
        const uint8_t *at = bytes;

        while (taxeld_receiver_take(&receiver, &at, &left, &request) == TAXELD_GOOD) {
            taxeld_hub_hear(&hub, &request);
            for (int n; (n = taxeld_hub_answer(&hub, packet, sizeof packet)) > 0;)
                say(packet, n);
        }
        if (hub.auto_sync && board_ms() - last_ms >= hub.period_ms) {
            last_ms = board_ms();
            send_scan();
        }
    }
}
